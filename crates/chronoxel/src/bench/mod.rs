//! Tables of papers, measured again: the paper's figures beside those of this machine.
//!
//! A bench gives a [`BenchReport`]: sections of rows, each with what the paper says and what was found here under the same
//! keys where both have them. What a bench works with lies in a [`Workplace`], which is removed at the end.

pub mod bernardon2006;
pub mod binotto2003;
pub mod binotto2003_speed;
pub mod ellsworth2000;
mod flight;
pub mod gpu_playback;
mod input;
pub mod leven2002;
pub mod lum2001;
pub mod lum2001_playback;
mod plot;
mod ripples;
mod stepping;
mod whole_texture;
mod workplace;

use serde::{Serialize, Serializer, ser::SerializeStruct};
use serde_json::{Map, Value};

pub use input::Input;
pub use plot::{Line, Panel, Plot};
pub use stepping::Stepping;
pub use workplace::Workplace;

/// What a bench found.
#[derive(Debug, Clone, PartialEq)]
pub struct BenchReport {
    /// The bench, named after the paper.
    pub name: &'static str,
    /// The machine that the figures are of.
    pub machine: String,
    /// The tables.
    pub sections: Vec<Section>,
    /// What is easier seen than read.
    pub plots: Vec<Plot>,
}

/// Rows that have the same columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Section {
    /// Which table of the paper, what is measured, on which data.
    pub title: String,
    /// What is shown of each row.
    pub columns: Vec<Column>,
    /// The rows.
    pub rows: Vec<Row>,
    /// How the figures were taken.
    pub notes: Vec<String>,
}

/// The paper's figures and those measured here, by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Row {
    /// What sets the row apart within its section.
    pub label: String,
    /// What the paper says; empty where it says nothing.
    pub paper: Map<String, Value>,
    /// What was measured; empty where nothing was.
    pub here: Map<String, Value>,
}

/// Whose figures a column shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Side {
    Paper,
    Here,
}

/// How numbers of a column are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Style {
    /// Three digits and a power of ten.
    Scientific,
    /// So many digits after the point.
    Fixed(usize),
}

/// One figure of each row of a section.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Column {
    /// Whose.
    pub side: Side,
    /// Its name in the row.
    pub key: &'static str,
    /// Its name for people.
    pub heading: &'static str,
    /// How it is written.
    pub style: Style,
}

impl Column {
    /// A column of the paper's figures.
    pub const fn paper(key: &'static str, heading: &'static str, style: Style) -> Self {
        Self { side: Side::Paper, key, heading, style }
    }

    /// A column of what was measured.
    pub const fn here(key: &'static str, heading: &'static str, style: Style) -> Self {
        Self { side: Side::Here, key, heading, style }
    }

    /// The figure of a row; empty where there is none.
    fn cell(&self, row: &Row) -> String {
        let figures = match self.side {
            Side::Paper => &row.paper,
            Side::Here => &row.here,
        };
        match (figures.get(self.key), self.style) {
            (None | Some(Value::Null), _) => String::new(),
            (Some(value), Style::Scientific) => format!("{:.2e}", value.as_f64().unwrap_or(f64::NAN)),
            (Some(value), Style::Fixed(digits)) => {
                format!("{:.digits$}", value.as_f64().unwrap_or(f64::NAN))
            }
        }
    }
}

impl Section {
    /// The cells of the section's table, headings first.
    pub fn cells(&self) -> Vec<Vec<String>> {
        let headings = self.columns.iter().map(|column| column.heading.to_owned());
        let mut cells = vec![std::iter::once(String::new()).chain(headings).collect::<Vec<_>>()];
        cells.extend(self.rows.iter().map(|row| {
            let figures = self.columns.iter().map(|column| column.cell(row));
            std::iter::once(row.label.clone()).chain(figures).collect()
        }));
        cells
    }
}

/// How large the simulations of a bench are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// Seconds, where the source is tiny as well: for tests.
    Tiny,
    /// A minute or so.
    Small,
    /// Near the paper's.
    Full,
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

/// A row as it is printed: its label stands for itself.
#[derive(Serialize)]
struct PrintedRow<'a> {
    label: String,
    paper: &'a Map<String, Value>,
    here: &'a Map<String, Value>,
}

impl Serialize for BenchReport {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let rows = self.sections.iter().flat_map(|section| {
            section.rows.iter().map(|row| PrintedRow {
                label: format!("{}: {}", section.title, row.label),
                paper: &row.paper,
                here: &row.here,
            })
        });
        let mut report = serializer.serialize_struct("BenchReport", 3)?;
        report.serialize_field("name", self.name)?;
        report.serialize_field("machine", &self.machine)?;
        report.serialize_field("rows", &rows.collect::<Vec<_>>())?;
        report.end()
    }
}

/// Processor, threads and system in words.
pub fn machine() -> String {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let processors = read("/proc/cpuinfo");
    let model = processors.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        (key.trim() == "model name").then(|| value.trim())
    });
    let release = read("/proc/sys/kernel/osrelease");
    format!(
        "{}, {} threads, {} {}",
        model.unwrap_or(std::env::consts::ARCH),
        rayon::current_num_threads(),
        std::env::consts::OS,
        release.trim()
    )
    .trim_end()
    .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn object(value: Value) -> Map<String, Value> {
        value.as_object().unwrap().clone()
    }

    fn report() -> BenchReport {
        let columns = vec![
            Column::paper("mse", "paper", Style::Scientific),
            Column::here("mse", "here", Style::Fixed(4)),
        ];
        let row = |label: &str, paper, here| Row {
            label: label.to_owned(),
            paper: object(paper),
            here: object(here),
        };
        let rows = vec![
            row("8x", json!({"mse": 0.000856}), json!({"mse": 0.00043})),
            row("4x", json!({"mse": 0.000304}), json!({})),
        ];
        let section = Section { title: "Table 6".to_owned(), columns, rows, notes: Vec::new() };
        BenchReport {
            name: "lum2001",
            machine: "abacus".to_owned(),
            sections: vec![section],
            plots: Vec::new(),
        }
    }

    #[test]
    fn a_report_is_printed_with_the_paper_beside_what_was_found() {
        let expected = json!({"name": "lum2001", "machine": "abacus", "rows": [
            {"label": "Table 6: 8x", "paper": {"mse": 0.000856}, "here": {"mse": 0.00043}},
            {"label": "Table 6: 4x", "paper": {"mse": 0.000304}, "here": {}},
        ]});
        assert_eq!(serde_json::to_value(report()).unwrap(), expected);
    }

    #[test]
    fn cells_are_empty_where_there_is_no_figure() {
        let cells = report().sections[0].cells();
        assert_eq!(cells, [["", "paper", "here"], ["8x", "8.56e-4", "0.0004"], ["4x", "3.04e-4", ""]]);
    }

    #[test]
    fn the_machine_is_named() {
        let machine = machine();
        assert!(machine.contains(" threads, ") && machine.contains(std::env::consts::OS), "{machine}");
    }
}
