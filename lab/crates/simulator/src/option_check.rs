//! Checks of options' values.

/// An option whose value cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("option {option} is {found}, expected {expected}")]
pub struct OptionError {
    pub option: &'static str,
    pub found: String,
    pub expected: &'static str,
}

/// Refuses a value unless `is_fine`.
pub(crate) fn require(
    option: &'static str,
    found: impl ToString,
    is_fine: bool,
    expected: &'static str,
) -> Result<(), OptionError> {
    if is_fine { Ok(()) } else { Err(OptionError { option, found: found.to_string(), expected }) }
}

pub(crate) fn positive(option: &'static str, value: f64) -> Result<(), OptionError> {
    require(option, value, value.is_finite() && value > 0.0, "a finite number above 0")
}

pub(crate) fn not_negative(option: &'static str, value: f64) -> Result<(), OptionError> {
    require(option, value, value.is_finite() && value >= 0.0, "a finite number of 0 or more")
}

/// Refuses a value outside of 0 to 1.
pub(crate) fn share(option: &'static str, value: f64) -> Result<(), OptionError> {
    require(option, value, (0.0..=1.0).contains(&value), "a number from 0 to 1")
}

/// Declares options with their defaults: `pub name: Type = default`.
macro_rules! with_defaults {
    ($(#[$meta:meta])* pub struct $name:ident {
        $($(#[$field_meta:meta])* pub $field:ident: $type:ty = $default:expr,)+
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct $name { $($(#[$field_meta])* pub $field: $type,)+ }

        impl Default for $name {
            fn default() -> Self {
                $name { $($field: $default,)+ }
            }
        }
    };
}
pub(crate) use with_defaults;
