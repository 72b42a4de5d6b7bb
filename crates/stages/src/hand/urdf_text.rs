//! The text of a URDF file, in the encoding that its XML declares.

use std::path::Path;

use blindgrasp_messages::file_kind::FileKind;
use encoding_rs::{Encoding, UTF_8};

use super::{HandError, read_bytes};

const DECLARED_UTF_8: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>";

/// Reads the text of a URDF.
///
/// # Errors
/// A file that cannot be read, is of more than 16 MiB, or is of another kind.
pub fn read_urdf(path: &Path) -> Result<String, HandError> {
    let bytes = read_bytes(path)?;
    if let Some(kind) = FileKind::of(&bytes).filter(|kind| !matches!(kind, FileKind::Urdf | FileKind::Empty)) {
        let message = format!("not a URDF: expected XML with one <robot>, found {}", kind.description());
        return Err(HandError::Invalid { path: path.into(), message });
    }
    Ok(decode_urdf(&bytes))
}

/// The text of a URDF in the encoding of its byte order mark or else of its XML declaration, which then declares UTF-8. Bytes
/// that the encoding does not have become `�`: comments may have them, and names with them are refused where they matter.
pub fn decode_urdf(bytes: &[u8]) -> String {
    let declared = declaration(&String::from_utf8_lossy(head(bytes))).and_then(|(_, label)| label);
    let encoding = declared.and_then(|label| Encoding::for_label(label.as_bytes())).unwrap_or(UTF_8);
    // It sees a byte order mark by itself.
    let (text, _, _) = encoding.decode(bytes);
    match declaration(&text) {
        Some((end, Some(label))) if !label.eq_ignore_ascii_case("utf-8") => DECLARED_UTF_8.to_owned() + &text[end..],
        _ => text.into_owned(),
    }
}

/// As many bytes as a declaration may have.
fn head(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len().min(200)]
}

/// The end of the XML declaration at the beginning of a text, and the encoding that it names.
fn declaration(text: &str) -> Option<(usize, Option<String>)> {
    if !text.starts_with("<?xml") {
        return None;
    }
    let end = text.find("?>")? + 2;
    let label = || {
        let (_, after) = text[..end].split_once("encoding")?;
        let after = after.trim_start().strip_prefix('=')?.trim_start();
        let quote = after.chars().next().filter(|quote| matches!(quote, '"' | '\''))?;
        after[1..].split_once(quote).map(|(label, _)| label.to_owned())
    };
    Some((end, label()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_encoding_is_the_declared_one() {
        let text = |label: &str| format!("<?xml version='1.0' encoding='{label}'?>\n<robot name='手'/>");
        let utf_8 = format!("{DECLARED_UTF_8}\n<robot name='手'/>");
        let gb2312 = encoding_rs::GBK.encode(&text("gb2312")).0.into_owned();
        assert_eq!(decode_urdf(&gb2312), utf_8);
        for bytes_of in [u16::to_le_bytes, u16::to_be_bytes] {
            let text: Vec<u16> = std::iter::once(0xFEFF).chain(text("UTF-16").encode_utf16()).collect();
            assert_eq!(decode_urdf(&text.into_iter().flat_map(bytes_of).collect::<Vec<u8>>()), utf_8);
        }
        assert_eq!(decode_urdf(text("klingon").as_bytes()), utf_8);
        assert_eq!(decode_urdf(text("utf-8").as_bytes()), text("utf-8"));
        assert_eq!(decode_urdf("\u{feff}<robot/>".as_bytes()), "<robot/>");
        assert_eq!(decode_urdf(b"<robot name='\xE9'/>"), "<robot name='�'/>");
        assert_eq!(decode_urdf(b""), "");
    }
}
