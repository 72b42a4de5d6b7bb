//! The readings of cells in a message of ROS 2: a list of numbers, an image or a cloud of points.

use blindgrasp_messages::MAX_CELLS;
use blindgrasp_ros::cdr::Value;

/// The readings of the cells in a message: the numbers of a field, the pixels of an image, or a field of the points of a
/// cloud.
pub(super) fn cells(value: &Value, field: &str) -> Result<Vec<f64>, String> {
    if let (Some(encoding), Some(Value::Bytes(data))) = (value.at("encoding"), value.at("data")) {
        let encoding = encoding.text().unwrap_or_default().to_owned();
        let kind = match encoding.as_str() {
            "mono8" | "8UC1" => Scalar::U8,
            "mono16" | "16UC1" => Scalar::U16,
            "32FC1" => Scalar::F32,
            "64FC1" => Scalar::F64,
            _ => {
                return Err(format!("its encoding is {encoding}, expected mono8, mono16, 8UC1, 16UC1, 32FC1 or 64FC1"));
            }
        };
        let (height, width, step) = (whole(value, "height")?, whole(value, "width")?, whole(value, "step")?);
        at_most_cells(height, width)?;
        let offsets = (0..height).flat_map(|row| (0..width).map(move |column| (row, column)));
        return scalars(
            &data,
            offsets.map(|(row, column)| row * step + column * kind.n_bytes()),
            kind,
            is_big_endian(value),
        );
    }
    if let (Some(Value::List(fields)), Some(Value::Bytes(data))) = (value.at("fields"), value.at("data")) {
        let found = fields.iter().find(|it| it.at("name").as_ref().and_then(Value::text) == Some(field));
        let found = found.ok_or_else(|| format!("its points have no field '{field}'"))?;
        let [datatype, offset] =
            ["datatype", "offset"].map(|name| found.at(name).and_then(|it| it.integer()).unwrap_or(-1));
        let kind = match datatype {
            2 => Scalar::U8,
            4 => Scalar::U16,
            7 => Scalar::F32,
            8 => Scalar::F64,
            other => return Err(format!("its field '{field}' has the datatype {other}, expected 2, 4, 7 or 8")),
        };
        let offset = usize::try_from(offset).map_err(|_| "its field has no offset")?;
        let n = at_most_cells(whole(value, "height")?, whole(value, "width")?)?;
        let step = whole(value, "point_step")?;
        return scalars(&data, (0..n).map(|point| point * step + offset), kind, is_big_endian(value));
    }
    let found = value.at(field).ok_or_else(|| format!("it has no field '{field}'"))?;
    found.numbers().ok_or_else(|| format!("its field '{field}' is no number or list of numbers"))
}

fn is_big_endian(value: &Value) -> bool {
    value.at("is_bigendian").and_then(|it| it.numbers()).is_some_and(|it| it.first() == Some(&1.0))
}

fn whole(value: &Value, name: &str) -> Result<usize, String> {
    let number = value.at(name).and_then(|it| it.integer());
    number.and_then(|it| usize::try_from(it).ok()).ok_or(format!("it has no {name}"))
}

/// The number of pixels or points. A size that no hand has takes no memory, whatever the message claims.
fn at_most_cells(height: usize, width: usize) -> Result<usize, String> {
    height
        .checked_mul(width)
        .filter(|n| *n <= MAX_CELLS && height <= MAX_CELLS)
        .ok_or_else(|| format!("its size is {height} x {width}, expected at most {MAX_CELLS} cells"))
}

#[derive(Clone, Copy)]
enum Scalar {
    U8,
    U16,
    F32,
    F64,
}

impl Scalar {
    fn n_bytes(self) -> usize {
        match self {
            Scalar::U8 => 1,
            Scalar::U16 => 2,
            Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }
}

fn appended(bits: u64, byte: &u8) -> u64 {
    bits << 8 | u64::from(*byte)
}

/// The numbers at these offsets.
fn scalars(data: &[u8], offsets: impl Iterator<Item = usize>, kind: Scalar, is_big: bool) -> Result<Vec<f64>, String> {
    let n = kind.n_bytes();
    let mut numbers = Vec::new();
    for offset in offsets {
        let end = offset.checked_add(n);
        let bytes = end.and_then(|end| data.get(offset..end)).ok_or("its data are too short for its size")?;
        let bits = if is_big { bytes.iter().fold(0, appended) } else { bytes.iter().rev().fold(0, appended) };
        numbers.push(match kind {
            Scalar::U8 | Scalar::U16 => bits as f64,
            Scalar::F32 => f32::from_bits(bits as u32).into(),
            Scalar::F64 => f64::from_bits(bits),
        });
    }
    Ok(numbers)
}

#[cfg(test)]
mod tests {
    use blindgrasp_recording::cdr::encode;
    use blindgrasp_ros::{cdr, standard};
    use serde::Serialize;

    use super::*;

    type Header = (i32, u32, &'static str);

    const HEADER: Header = (0, 1, "palm");

    fn read(name: &str, field: &str, value: &impl Serialize) -> Result<Vec<f64>, String> {
        let definition = standard::definition(name).expect("known");
        let mut bytes = Vec::new();
        encode(value, &mut bytes).expect("CDR");
        cells(&cdr::read(&definition, &bytes).expect("a message"), field)
    }

    #[test]
    fn images_and_clouds_give_a_number_a_cell() {
        let image = |size: (u32, u32), encoding: &str, big: u8, step: u32, data: &[u8]| {
            read("sensor_msgs/msg/Image", "data", &(HEADER, size, encoding, big, step, data))
        };
        // The rows end with a byte that is no pixel.
        assert_eq!(image((2, 2), "mono8", 0, 3, &[1, 2, 9, 3, 4, 9]), Ok(vec![1.0, 2.0, 3.0, 4.0]));
        assert_eq!(image((1, 2), "16UC1", 1, 4, &[1, 0, 0, 2]), Ok(vec![256.0, 2.0]));
        let float = 1.5_f32.to_le_bytes();
        assert_eq!(image((1, 1), "32FC1", 0, 4, &float), Ok(vec![1.5]));
        assert!(image((1, 2), "32FC1", 0, 8, &float).expect_err("short").contains("too short"));
        assert!(image((1, 1), "rgb8", 0, 3, &[1, 2, 3]).expect_err("colours").contains("its encoding is rgb8"));
        // Sizes that would take all memory.
        assert!(image((u32::MAX, 1), "mono8", 0, 0, &[1]).expect_err("large").contains("expected at most"));
        assert!(image((u32::MAX, 0), "mono8", 0, 0, &[1]).expect_err("large").contains("expected at most"));
        let cloud = |width: u32, step: u32, data: &[u8]| {
            let fields = [("x", 0_u32, 7_u8, 1_u32), ("force", 4, 7, 1)];
            let rest = (false, step, step.wrapping_mul(width), data, true);
            read("sensor_msgs/msg/PointCloud2", "force", &(HEADER, 1_u32, width, fields.as_slice(), rest))
        };
        let points: Vec<u8> = [0.5_f32, 1.5, 0.5, 2.5].iter().flat_map(|it| it.to_le_bytes()).collect();
        assert_eq!(cloud(2, 8, &points), Ok(vec![1.5, 2.5]));
        assert!(cloud(3, 8, &points).expect_err("short").contains("too short"));
        assert!(cloud(u32::MAX, 0, &points).expect_err("large").contains("expected at most"));
    }
}
