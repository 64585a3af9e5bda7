//! A table of text, for a terminal and for Markdown.

use std::fmt::Write as _;

/// A table.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// The table's title.
    pub title: String,
    /// A note on how to read the table.
    pub note: String,
    /// Names of the columns.
    pub head: Vec<String>,
    /// The cells, row by row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows.
    pub(super) fn new(title: &str, note: &str, head: &[&str]) -> Self {
        Self {
            title: title.to_owned(),
            note: note.to_owned(),
            head: head.iter().map(|&name| name.to_owned()).collect(),
            rows: Vec::new(),
        }
    }

    /// The head and rows as plain text in columns.
    pub fn text(&self) -> String {
        let lines: Vec<&Vec<String>> = std::iter::once(&self.head).chain(&self.rows).collect();
        let widths: Vec<usize> = (0..self.head.len())
            .map(|column| lines.iter().map(|line| line[column].chars().count()).max())
            .map(Option::unwrap_or_default)
            .collect();
        let mut text = String::new();
        for line in lines {
            let mut row = String::new();
            for (column, (cell, &width)) in line.iter().zip(&widths).enumerate() {
                if column == 0 {
                    let _ = write!(row, "{cell:width$}");
                } else {
                    let _ = write!(row, "  {cell:>width$}");
                }
            }
            text += row.trim_end();
            text.push('\n');
        }
        text
    }

    /// A section of a page: the title, the note and the table, in Markdown.
    pub fn section(&self) -> String {
        format!("## {}\n\n{}", self.title, self.markdown())
    }

    fn markdown(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule: Vec<String> = (0..self.head.len())
            .map(|column| if column == 0 { "---" } else { "---:" }.to_owned())
            .collect();
        let rows: String = self.rows.iter().map(|row| line(row)).collect();
        format!("{}\n\n{}{}{rows}", self.note, line(&self.head), line(&rule))
    }
}
