//! A report as a page: one HTML file that asks the network for nothing. It runs no script but those that it is given.

use std::fmt::Write;

use super::escape;

const STYLE: &str = include_str!("../assets/report.css");

/// A page under way. Texts that are given to it are HTML, but for titles.
pub struct ReportPage {
    text: String,
}

impl ReportPage {
    /// Begins a page with its title and a sentence or two for a reader who reads no further.
    pub fn begin(title: &str, lead: &str) -> ReportPage {
        let title = escape(title);
        let text = format!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n\
             <style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n<p class=\"lead\">{lead}</p>\n"
        );
        ReportPage { text }
    }

    pub fn section(&mut self, title: &str, body: &str) {
        // Writing to a string cannot fail.
        let _ = writeln!(self.text, "<section>\n<h2>{}</h2>\n{body}</section>", escape(title));
    }

    pub fn figure(&mut self, picture: &str, caption: &str) {
        let caption = match caption {
            "" => String::new(),
            caption => format!("<figcaption class=\"caption\">{caption}</figcaption>"),
        };
        // On a small screen it is scrolled, also by keys.
        self.raw(&format!("<figure tabindex=\"0\">\n{picture}{caption}</figure>\n"));
    }

    /// Pictures side by side.
    pub fn pairs(&mut self, pictures: impl Iterator<Item = String>) {
        self.raw("<div class=\"pairs\">\n");
        pictures.for_each(|picture| self.figure(&picture, ""));
        self.raw("</div>\n");
    }

    pub fn raw(&mut self, html: &str) {
        self.text.push_str(html);
    }

    pub fn finish(mut self) -> String {
        self.raw("</main>\n</body>\n</html>\n");
        self.text
    }
}

/// A table: the heads with whether their column has numbers, and the rows, of which some are marked.
pub fn report_table(head: &[(&str, bool)], rows: &[(bool, Vec<String>)]) -> String {
    let class = |number: bool| if number { " class=\"number\"" } else { "" };
    let mut text = String::from("<div class=\"scroll\" tabindex=\"0\"><table>\n<thead><tr>");
    for (name, number) in head {
        let _ = write!(text, "<th{}>{name}</th>", class(*number));
    }
    text.push_str("</tr></thead>\n<tbody>\n");
    for (own, cells) in rows {
        text.push_str(if *own { "<tr class=\"own\">" } else { "<tr>" });
        for (cell, (_, number)) in cells.iter().zip(head) {
            let _ = write!(text, "<td{}>{cell}</td>", class(*number));
        }
        text.push_str("</tr>\n");
    }
    text.push_str("</tbody>\n</table></div>\n");
    text
}
