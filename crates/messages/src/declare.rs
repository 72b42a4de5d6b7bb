//! `message!` and its parts: one declaration gives a message all its shapes.
//!
//! A field of the owned struct is declared as in any struct. Before it may stand, in this order: doc comments; its
//! comment in the ROS 2 definition, `#[ros = "…"]`, which is documentation as well. Then come an attribute of serde and
//! the greatest length of its list or greatest value of its number, `#[max(…)]`.
//!
//! A field of the head has the owned field's name and its type in shared memory ([`Raw`]). `n: u32 => list` is the
//! number of items that belong to a list or a text of the message, and `name: u32 = 0` is always that number. The last
//! line names the type of the items and the list or text that gets the items behind the counted ones. Without that
//! line, the file implements [`Message`](crate::Message) by hand; and `Serialize` without `#[derive(serde::Serialize)]`.

use crate::MessageError;

/// A struct in a message: its fields in ROS 2 definitions, and their limits.
pub(crate) trait Declared {
    fn ros_fields() -> String;
    fn ros_parts() -> String;
    fn check_limits(&self) -> Result<(), MessageError>;
}

/// A value that lies in shared memory as `R`.
pub(crate) trait Raw<R>: Sized {
    fn to_raw(&self) -> R;
    fn from_raw(field: &'static str, raw: R) -> Result<Self, MessageError>;
}

macro_rules! raw_as_they_are {
    ($($type:ty),+) => {
        $(impl Raw<$type> for $type {
            fn to_raw(&self) -> $type { *self }
            fn from_raw(_: &'static str, raw: $type) -> Result<Self, MessageError> { Ok(raw) }
        })+
    };
}
raw_as_they_are!(u32, u64, f64);

impl Raw<u32> for bool {
    fn to_raw(&self) -> u32 {
        (*self).into()
    }
    fn from_raw(field: &'static str, raw: u32) -> Result<Self, MessageError> {
        match raw {
            0 => Ok(false),
            1 => Ok(true),
            code => Err(MessageError::Code { field, code }),
        }
    }
}

/// A list or a text that lies in shared memory as items.
pub(crate) trait Tail<I>: Sized {
    fn items(&self) -> &[I];
    fn from_items(field: &'static str, items: &[I]) -> Result<Self, MessageError>;

    /// Takes the first `n_items` of `items`.
    fn take(field: &'static str, n_items: u32, items: &mut &[I]) -> Result<Self, MessageError> {
        at_most(field, n_items as usize, items.len())?;
        let (first, rest) = items.split_at(n_items as usize);
        *items = rest;
        Self::from_items(field, first)
    }
}

impl<I: Clone> Tail<I> for Vec<I> {
    fn items(&self) -> &[I] {
        self
    }
    fn from_items(_: &'static str, items: &[I]) -> Result<Self, MessageError> {
        Ok(items.to_vec())
    }
}

impl Tail<u8> for String {
    fn items(&self) -> &[u8] {
        self.as_bytes()
    }
    fn from_items(field: &'static str, items: &[u8]) -> Result<Self, MessageError> {
        String::from_utf8(items.to_vec()).map_err(|_| MessageError::Text { field })
    }
}

/// A value that has a greatest length or is a count itself.
pub(crate) trait Count {
    fn count(&self) -> usize;
}

impl<T> Count for Vec<T> {
    fn count(&self) -> usize {
        self.len()
    }
}

impl Count for String {
    fn count(&self) -> usize {
        self.len()
    }
}

impl Count for u32 {
    fn count(&self) -> usize {
        *self as usize
    }
}

pub(crate) fn at_most(field: &'static str, found: usize, most: usize) -> Result<(), MessageError> {
    if found > most {
        return Err(MessageError::Length { field, found, expected: format!("0 to {most}") });
    }
    Ok(())
}

/// Declares a struct that lies in shared memory.
macro_rules! shared {
    (#[doc = $doc:literal] $(#[$($meta:tt)*])* pub struct $name:ident {
        $($(#[$($field_meta:tt)*])* pub $field:ident: $type:ty,)+
    }) => {
        #[doc = $doc]
        #[repr(C)]
        #[derive(Debug, Clone, Copy, Default)]
        #[cfg_attr(feature = "ipc", derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout))]
        $(#[$($meta)*])*
        pub struct $name { $($(#[$($field_meta)*])* pub $field: $type,)+ }

        layout! { $name, $doc, $($field: $type,)+ }
    };
}

/// Writes down the layout of a struct in shared memory, from which the Python file is made and tested.
macro_rules! layout {
    ($name:ident, $doc:literal, $($field:ident: $type:ty,)+) => {
        #[cfg(all(test, feature = "ipc"))]
        impl crate::layout::Shared for $name {
            fn layout() -> crate::layout::Struct {
                let fields = vec![$(crate::layout::field::<$type>(stringify!($field), std::mem::offset_of!($name, $field))),+];
                crate::layout::of_struct::<$name>(stringify!($name), $doc, fields)
            }
        }
    };
}

/// Declares a struct with a ROS 2 definition; `shared`: that lies in shared memory as it is.
macro_rules! declared {
    (shared #[doc = $doc:literal] $(#[$($meta:tt)*])* pub struct $name:ident {
        $($(#[$($field_meta:tt)*])* pub $field:ident: $type:ty,)+
    }) => {
        declared! {
            #[doc = $doc]
            #[repr(C)]
            #[derive(Debug, Clone, Copy, Default)]
            #[cfg_attr(feature = "ipc", derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout))]
            $(#[$($meta)*])*
            pub struct $name { $($(#[$($field_meta)*])* pub $field: $type,)+ }
        }

        layout! { $name, $doc, $($field: $type,)+ }
    };

    ($(#[$($meta:tt)*])* pub struct $name:ident {
        $(
            $(#[doc = $doc:literal])*
            $(#[ros = $ros:literal])*
            $(#[serde($($serde:tt)*)])?
            $(#[max($max:expr)])?
            pub $field:ident: $type:ty,
        )+
    }) => {
        $(#[$($meta)*])*
        pub struct $name {
            $($(#[doc = $doc])* $(#[doc = $ros])* $(#[serde($($serde)*)])? pub $field: $type,)+
        }

        impl crate::declare::Declared for $name {
            fn ros_fields() -> String {
                use crate::ros::RosType;
                let mut text = String::new();
                $(
                    $(text += concat!("# ", $ros, "\n");)*
                    text += &<$type>::ros_lines(stringify!($field));
                )+
                text
            }

            fn ros_parts() -> String {
                use crate::ros::RosType;
                [$(<$type>::ros_part()),+].concat()
            }

            fn check_limits(&self) -> Result<(), crate::MessageError> {
                $($(crate::declare::at_most(stringify!($field), crate::declare::Count::count(&self.$field), $max)?;)?)+
                Ok(())
            }
        }

        impl crate::ros::RosType for $name {
            fn ros_name() -> String { stringify!($name).into() }
            fn ros_part() -> String {
                use crate::declare::Declared;
                crate::ros::part(stringify!($name), &Self::ros_fields())
            }
        }
    };
}

/// Declares a message.
macro_rules! message {
    (
        $(#[doc = $doc:literal])+
        $(#[derive($derive:path)])?
        pub struct $name:ident = $type_name:literal on $topic:literal { $($fields:tt)+ }
        $(also check $check:path;)?
        $(
            #[doc = $head_doc:literal]
            pub struct $head:ident = $head_name:literal $head_fields:tt
            $(items: $item:ty $(=> $tail:ident)?;)?
        )?
    ) => {
        declared! {
            $(#[doc = $doc])+
            #[derive(Debug, Clone, PartialEq, Default, serde::Deserialize)]
            $(#[derive($derive)])?
            pub struct $name { $($fields)+ }
        }

        impl crate::Recorded for $name {
            const TYPE_NAME: &'static str = $type_name;
            const TOPIC: &'static str = $topic;
            const SCHEMA: &'static str = concat!("blindgrasp_msgs/msg/", stringify!($name));

            fn record(sample: crate::Stamped<Self>) -> crate::Record {
                sample.into()
            }

            fn definition() -> String {
                use crate::declare::Declared;
                crate::ros::message(&Self::ros_fields(), &Self::ros_parts())
            }

            fn check(&self) -> Result<(), crate::MessageError> {
                crate::declare::Declared::check_limits(self)?;
                $($check(self)?;)?
                Ok(())
            }
        }

        $(
            message! { @head #[doc = $head_doc] $head $head_name $head_fields }
            $(message! { @convert $name $head $item, $head_fields $($tail)? })?
        )?
    };

    (@head #[doc = $doc:literal] $head:ident $head_name:literal {
        $($field:ident: $raw:ty $(= $fixed:literal)? $(=> $list:ident)?,)+
    }) => {
        // The derived code of `shared!` and `declared!` knows the traits by these names.
        #[cfg(feature = "ipc")]
        use crate::shared_memory::{FromBytes, Immutable, IntoBytes, KnownLayout, ZeroCopySend};

        shared! {
            #[doc = $doc]
            #[cfg_attr(feature = "ipc", type_name($head_name))]
            pub struct $head { pub header: crate::Header, $(pub $field: $raw,)+ }
        }
    };

    (@convert $name:ident $head:ident $item:ty, {
        $($field:ident: $raw:ty $(= $fixed:literal)? $(=> $list:ident)?,)+
    } $($tail:ident)?) => {
        impl crate::Message for $name {
            type Head = $head;
            type Item = $item;

            fn header(head: &$head) -> &crate::Header {
                &head.header
            }

            fn header_mut(head: &mut $head) -> &mut crate::Header {
                &mut head.header
            }

            fn to_parts(&self, header: crate::Header) -> ($head, Vec<$item>) {
                let head = $head { header, $($field: message!(@raw self $field $(= $fixed)? $(=> $list)?),)+ };
                let lists: &[&[$item]] = &[
                    $($(crate::declare::Tail::items(&self.$list),)?)+
                    $(crate::declare::Tail::items(&self.$tail),)?
                ];
                (head, lists.concat())
            }

            fn from_parts(head: &$head, items: &[$item]) -> Result<Self, crate::MessageError> {
                let mut message = $name::default();
                #[allow(unused_mut)]
                let mut _rest = items;
                $(message!(@read message head _rest $field $(= $fixed)? $(=> $list)?);)+
                $(message.$tail = crate::declare::Tail::from_items(stringify!($tail), _rest)?;)?
                crate::Recorded::check(&message)?;
                Ok(message)
            }
        }
    };

    (@raw $message:ident $field:ident) => { crate::declare::Raw::to_raw(&$message.$field) };
    (@raw $message:ident $field:ident = $fixed:literal) => { $fixed };
    (@raw $message:ident $field:ident => $list:ident) => { $message.$list.len() as u32 };

    (@read $message:ident $head:ident $items:ident $field:ident) => {
        $message.$field = crate::declare::Raw::from_raw(stringify!($field), $head.$field)?
    };
    (@read $message:ident $head:ident $items:ident $field:ident = $fixed:literal) => {};
    (@read $message:ident $head:ident $items:ident $field:ident => $list:ident) => {
        $message.$list = crate::declare::Tail::take(stringify!($list), $head.$field, &mut $items)?
    };
}
