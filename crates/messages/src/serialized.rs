//! How fields of messages are serialised where serde's own way does not fit.

use serde::Deserialize;
use serde::de::{Deserializer, Error as _, SeqAccess, Visitor};

/// Identities as 16 hex digits in JSON: readers in other languages would round a 64-bit number.
pub mod hex_id {
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    /// # Errors
    /// As the serializer.
    pub fn serialize<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            format!("{id:016x}").serialize(serializer)
        } else {
            id.serialize(serializer)
        }
    }

    /// # Errors
    /// The text is not a hexadecimal number.
    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
        if !deserializer.is_human_readable() {
            return u64::deserialize(deserializer);
        }
        let text = String::deserialize(deserializer)?;
        u64::from_str_radix(&text, 16).map_err(|_| D::Error::custom(format!("'{text}' is not 16 hex digits")))
    }
}

/// The value of a number that a line leaves out.
pub(crate) fn nan() -> f64 {
    f64::NAN
}

/// A number that is not finite is null in JSON.
pub(crate) fn nan_for_null<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    if deserializer.is_human_readable() {
        return Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN));
    }
    f64::deserialize(deserializer)
}

/// The most memory that a list takes before its items are read: no list of a message is longer.
const MAX_RESERVED_BYTES: usize = 64 << 10;

/// Reads a list. Its claimed length does not take memory before the items are there, because the bytes may come from a
/// stranger.
///
/// # Errors
/// More than `most` items, or the deserializer's error.
pub fn read_list<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
    most: usize,
) -> Result<Vec<T>, D::Error> {
    struct List<T>(usize, std::marker::PhantomData<T>);

    impl<'de, T: Deserialize<'de>> Visitor<'de> for List<T> {
        type Value = Vec<T>;

        fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            f.write_str("a list")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Vec<T>, A::Error> {
            let most_reserved = MAX_RESERVED_BYTES / size_of::<T>().max(1);
            let mut list = Vec::with_capacity(items.size_hint().unwrap_or(0).min(most_reserved).min(self.0));
            while let Some(item) = items.next_element()? {
                if list.len() == self.0 {
                    return Err(A::Error::custom(format!("a list of more than {} items", self.0)));
                }
                list.push(item);
            }
            Ok(list)
        }
    }

    deserializer.deserialize_seq(List(most, std::marker::PhantomData))
}

/// [`read_list`] of any length: [`Recorded::check`](crate::Recorded::check) names the field that is too long.
pub(crate) fn any_list<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    read_list(deserializer, usize::MAX)
}
