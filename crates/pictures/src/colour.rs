//! Colours: what things are drawn in, and the scale that forces are read from.

/// An sRGB colour, each channel 0 to 1.
pub(super) type Rgb = [f64; 3];

/// The hand's links.
pub(super) const HAND: Rgb = [0.812, 0.827, 0.847];
/// The object.
pub(super) const OBJECT: Rgb = [0.384, 0.620, 0.796];
/// A cell that feels nothing.
pub(super) const SILENT_CELL: Rgb = [0.957, 0.965, 0.973];

/// From the least to the largest force: lightness falls evenly, so the scale survives greyscale printing and the
/// common forms of colour blindness.
const FORCE_STOPS: [Rgb; 5] =
    [[1.000, 0.902, 0.659], [0.984, 0.706, 0.345], [0.910, 0.420, 0.290], [0.706, 0.165, 0.365], [0.316, 0.094, 0.420]];

/// The colour of a force that is `share` (0 to 1) of the scale's largest.
pub(super) fn force_colour(share: f64) -> Rgb {
    let along = share.clamp(0.0, 1.0) * (FORCE_STOPS.len() - 1) as f64;
    let idx = (along as usize).min(FORCE_STOPS.len() - 2);
    let (from, to) = (oklab(FORCE_STOPS[idx]), oklab(FORCE_STOPS[idx + 1]));
    let part = along - idx as f64;
    from_oklab(std::array::from_fn(|channel| from[channel] + part * (to[channel] - from[channel])))
}

/// `#rrggbb`.
pub(super) fn hex(colour: Rgb) -> String {
    let [red, green, blue] = bytes(colour);
    format!("#{red:02x}{green:02x}{blue:02x}")
}

/// Each channel as a byte.
pub(super) fn bytes(colour: Rgb) -> [u8; 3] {
    colour.map(|channel| (channel.clamp(0.0, 1.0) * 255.0).round() as u8)
}

/// Björn Ottosson's OKLab, in which equal steps look equal.
fn oklab(colour: Rgb) -> [f64; 3] {
    let [r, g, b] =
        colour.map(|channel| if channel <= 0.04045 { channel / 12.92 } else { ((channel + 0.055) / 1.055).powf(2.4) });
    let l = (0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b).cbrt();
    let m = (0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b).cbrt();
    let s = (0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b).cbrt();
    [
        0.2104542553 * l + 0.7936177850 * m - 0.0040720468 * s,
        1.9779984951 * l - 2.4285922050 * m + 0.4505937099 * s,
        0.0259040371 * l + 0.7827717662 * m - 0.8086757660 * s,
    ]
}

fn from_oklab([lightness, a, b]: [f64; 3]) -> Rgb {
    let l = (lightness + 0.3963377774 * a + 0.2158037573 * b).powi(3);
    let m = (lightness - 0.1055613458 * a - 0.0638541728 * b).powi(3);
    let s = (lightness - 0.0894841775 * a - 1.2914855480 * b).powi(3);
    let linear = [
        4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
        -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
        -0.0041960863 * l - 0.7034186147 * m + 1.7076147010 * s,
    ];
    linear.map(|channel: f64| {
        let channel = channel.clamp(0.0, 1.0);
        if channel <= 0.0031308 { 12.92 * channel } else { 1.055 * channel.powf(1.0 / 2.4) - 0.055 }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_force_scale_only_darkens() {
        let found: Vec<f64> = (0..=100).map(|idx| oklab(force_colour(f64::from(idx) / 100.0))[0]).collect();
        assert!(found.windows(2).all(|pair| pair[1] < pair[0]), "{found:?}");
        for (idx, stop) in FORCE_STOPS.iter().enumerate() {
            let back = force_colour(idx as f64 / 4.0);
            assert!((0..3).all(|channel| (back[channel] - stop[channel]).abs() < 1e-6), "{back:?} {stop:?}");
        }
    }

    #[test]
    fn white_and_black_are_white_and_black() {
        assert!((oklab([1.0; 3])[0] - 1.0).abs() < 1e-6 && oklab([0.0; 3])[0].abs() < 1e-9);
        assert_eq!(hex([1.0, 0.0, 0.5]), "#ff0080");
    }
}
