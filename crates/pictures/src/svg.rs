//! Writing SVG.

use std::fmt::{Display, Write};

/// An SVG in the making. Numbers are rounded to hundredths of a pixel, so that a picture's bytes don't hang on the
/// last digits of a sine.
#[derive(Debug, Default)]
pub(super) struct Svg {
    body: String,
}

/// Where a text hangs on its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

impl Svg {
    /// An element without content.
    pub(super) fn element(&mut self, name: &str, attributes: &[(&str, &dyn Display)]) {
        self.start(name, attributes);
        self.body.truncate(self.body.len() - 2);
        self.body.push_str("/>\n");
    }

    /// An element's start; what follows is inside it until [`Svg::end`].
    pub(super) fn start(&mut self, name: &str, attributes: &[(&str, &dyn Display)]) {
        self.body.push('<');
        self.body.push_str(name);
        for (attribute, value) in attributes {
            // Writing to a string cannot fail.
            let _ = write!(self.body, " {attribute}=\"{}\"", escape(&value.to_string()));
        }
        self.body.push_str(">\n");
    }

    /// Everything that another one has so far.
    pub(super) fn append(&mut self, other: Svg) {
        self.body.push_str(&other.body);
    }

    /// An element's end.
    pub(super) fn end(&mut self, name: &str) {
        let _ = writeln!(self.body, "</{name}>");
    }

    /// A line of text in a class of the style sheet.
    pub(super) fn text(&mut self, [x, y]: [f64; 2], anchor: Anchor, class: &str, text: &str) {
        self.text_with([x, y], anchor, class, text, &[]);
    }

    /// A line of text with further attributes.
    pub(super) fn text_with(
        &mut self,
        [x, y]: [f64; 2],
        anchor: Anchor,
        class: &str,
        text: &str,
        attributes: &[(&str, &dyn Display)],
    ) {
        let anchor = match anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let (x, y) = (px(x), px(y));
        let mut all: Vec<(&str, &dyn Display)> =
            vec![("x", &x), ("y", &y), ("text-anchor", &anchor), ("class", &class)];
        all.extend(attributes);
        self.start("text", &all);
        self.body.pop();
        let _ = writeln!(self.body, "{}</text>", escape(text));
    }

    /// The whole picture: a light card, whatever is behind it, so that it can be read on dark pages too.
    pub(super) fn finish(self, width: f64, height: f64, title: &str, style: &str) -> String {
        let (w, h) = (px(width), px(height));
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {w} {h}\" width=\"{w}\" height=\"{h}\" \
             role=\"img\">\n<title>{}</title>\n<style>{style}</style>\n\
             <rect x=\"0.5\" y=\"0.5\" width=\"{}\" height=\"{}\" rx=\"12\" fill=\"#ffffff\" stroke=\"#d8dce2\"/>\n{}</svg>\n",
            escape(title),
            px(width - 1.0),
            px(height - 1.0),
            self.body
        )
    }
}

/// A length in pixels, to hundredths.
pub(super) fn px(value: f64) -> f64 {
    // Adding 0 turns -0 into 0.
    (value * 100.0).round() / 100.0 + 0.0
}

/// About how wide a text of this size is: enough to keep things apart, whichever sans-serif font is there.
pub(super) fn text_width(text: &str, font_size: f64) -> f64 {
    let of = |letter: char| match letter {
        'i' | 'j' | 'l' | '.' | ',' | ':' | '\'' | '|' | '!' | ' ' => 0.30,
        'f' | 't' | 'r' | '(' | ')' | '-' | '/' => 0.40,
        'm' | 'w' | 'M' | 'W' | '%' | '@' => 0.90,
        letter if letter.is_uppercase() => 0.70,
        letter if letter.is_ascii() || letter.is_alphabetic() => 0.57,
        _ => 0.8,
    };
    font_size * text.chars().map(of).sum::<f64>()
}

/// At most so wide, cut with an ellipsis.
pub(super) fn fit_text(text: &str, font_size: f64, width: f64) -> String {
    if text_width(text, font_size) <= width {
        return text.into();
    }
    let mut cut: String = text.into();
    while !cut.is_empty() && text_width(&cut, font_size) + 0.8 * font_size > width {
        cut.pop();
    }
    format!("{}…", cut.trim_end())
}

/// For text and attributes of XML and HTML. Characters that XML cannot hold become the replacement character.
pub(super) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\n' | '\t' => escaped.push(' '),
            '\u{0}'..='\u{1f}' | '\u{fffe}' | '\u{ffff}' => escaped.push('\u{fffd}'),
            other => escaped.push(other),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_a_name_holds_the_xml_stays_well_formed() {
        let mut svg = Svg::default();
        svg.text([1.0, -0.001], Anchor::End, "note", "a<b & \"c\"\u{1}");
        svg.element("rect", &[("x", &px(1.0 / 3.0)), ("id", &"\"><script>")]);
        let text = svg.finish(100.0, 50.0, "<&>", "");
        assert!(text.contains(">a&lt;b &amp; &quot;c&quot;\u{fffd}</text>") && text.contains("y=\"0\""), "{text}");
        assert!(text.contains("x=\"0.33\"") && !text.contains("<script>"), "{text}");
    }

    #[test]
    fn long_names_are_cut() {
        assert_eq!(fit_text("distal_1", 12.0, 100.0), "distal_1");
        let cut = fit_text("a_link_with_a_very_long_name_indeed", 12.0, 100.0);
        assert!(cut.ends_with('…') && text_width(&cut, 12.0) <= 101.0, "{cut}");
    }
}
