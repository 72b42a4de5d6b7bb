//! Samples to pixels, pixels to PNG.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

use super::PictureError;
use super::colour::bytes;

/// An image with transparency.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Image {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Red, green, blue, opacity of each pixel, row by row from the upper left.
    pub(super) rgba: Vec<u8>,
}

impl Image {
    /// Each pixel the mean of its square of samples; `sample(x, y)` says a sample's colour, and its opacity (0 to 1).
    pub(super) fn from_samples(
        width: usize,
        height: usize,
        samples_per_side: usize,
        sample: impl Fn(usize, usize) -> ([f64; 3], f64),
    ) -> Image {
        let mut rgba = Vec::with_capacity(4 * width * height);
        let n_samples = (samples_per_side * samples_per_side) as f64;
        for y in 0..height {
            for x in 0..width {
                let (mut colour, mut opacity) = ([0.0; 3], 0.0);
                for idx in 0..samples_per_side * samples_per_side {
                    let (dx, dy) = (idx % samples_per_side, idx / samples_per_side);
                    let (of_sample, part) = sample(x * samples_per_side + dx, y * samples_per_side + dy);
                    opacity += part;
                    (0..3).for_each(|channel| colour[channel] += part * of_sample[channel]);
                }
                // Where nothing is seen, colour says nothing: 0 compresses best.
                let colour = if opacity > 0.0 { colour.map(|channel| channel / opacity) } else { [0.0; 3] };
                rgba.extend(bytes(colour));
                rgba.push((255.0 * opacity / n_samples).round() as u8);
            }
        }
        Image { width, height, rgba }
    }

    /// As a PNG file.
    pub(super) fn to_png(&self) -> Result<Vec<u8>, PictureError> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_filter(png::Filter::Adaptive);
        write(encoder, &self.rgba)?;
        Ok(bytes)
    }
}

impl Image {
    /// As a PNG file on white, in few enough shades to be small.
    pub(super) fn to_small_png(&self) -> Result<Vec<u8>, PictureError> {
        const STEP: f64 = 5.0;
        let on_white = |pixel: &[u8]| {
            let opacity = f64::from(pixel[3]) / 255.0;
            let channel = |idx: usize| opacity * f64::from(pixel[idx]) + (1.0 - opacity) * 255.0;
            [0, 1, 2].map(|idx| ((channel(idx) / STEP).round() * STEP) as u8)
        };
        let rgb: Vec<u8> = self.rgba.chunks_exact(4).flat_map(on_white).collect();
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        write(encoder, &rgb)?;
        Ok(bytes)
    }
}

fn write(mut encoder: png::Encoder<'_, &mut Vec<u8>>, pixels: &[u8]) -> Result<(), PictureError> {
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    Ok(writer.finish()?)
}

/// A PNG as an address that holds it whole.
pub(super) fn data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_means_of_what_is_seen() {
        // Left pixel: half red, half nothing; right pixel: black and white.
        let image = Image::from_samples(2, 1, 2, |x, y| match (x, y) {
            (0 | 1, 0) => ([1.0, 0.0, 0.0], 1.0),
            (0 | 1, _) => ([0.0; 3], 0.0),
            (2, _) => ([1.0; 3], 1.0),
            _ => ([0.0; 3], 1.0),
        });
        assert_eq!(image.rgba, [255, 0, 0, 128, 128, 128, 128, 255]);
    }

    #[test]
    fn a_png_is_read_back_as_it_was() {
        let image = Image { width: 3, height: 2, rgba: (0..24).map(|idx| idx * 10).collect() };
        let bytes = image.to_png().expect("encoded");
        let mut reader = png::Decoder::new(std::io::Cursor::new(&bytes)).read_info().expect("a PNG");
        let mut back = vec![0; reader.output_buffer_size().expect("small")];
        reader.next_frame(&mut back).expect("pixels");
        assert_eq!(back, image.rgba);
        assert!(data_uri(&bytes).starts_with("data:image/png;base64,iVBORw0KGgo"));
    }
}
