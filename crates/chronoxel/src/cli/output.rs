//! What the command line prints, and where: results on stdout, everything else on stderr.

use std::io::Write;

use anyhow::Context;
use serde::Serialize;

/// Prints one JSON object on stdout. A closed pipe is not an error.
pub fn json(value: &impl Serialize) -> anyhow::Result<()> {
    line(&serde_json::to_string(value)?)
}

/// Prints one line on stdout. A closed pipe is not an error.
pub fn line(text: &str) -> anyhow::Result<()> {
    match writeln!(std::io::stdout().lock(), "{text}") {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to stdout"),
    }
}

/// Prints a warning on stderr.
pub fn warning(text: &str) {
    let _ = writeln!(std::io::stderr().lock(), "chronoxel: warning: {text}");
}

/// Prints an error and its causes on one line of stderr.
pub fn error(error: &anyhow::Error) {
    let _ = writeln!(std::io::stderr().lock(), "chronoxel: error: {}", on_one_line(error));
}

/// An error and its causes; what a message says of its cause itself is not said twice.
fn on_one_line(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        match text.as_str() {
            "" => text = cause,
            said if said.contains(&cause) => {}
            _ => text = format!("{text}: {cause}"),
        }
    }
    text.replace(char::is_control, " ")
}

/// A number for people: six digits, without trailing zeros.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let exponent = value.abs().log10().floor() as i32;
    if !(-5..15).contains(&exponent) {
        return format!("{value:.5e}");
    }
    let text = format!("{value:.decimals$}", decimals = (5 - exponent).max(0) as usize);
    match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text,
    }
}

/// Pads the columns of a table: the first to the left, the others to the right.
pub fn table(rows: &[Vec<String>]) -> String {
    let num_columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |c: usize| rows.iter().filter_map(|r| r.get(c)).map(|t| t.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..num_columns).map(width).collect();
    let lines = rows.iter().map(|row| {
        let cells = row.iter().enumerate().map(|(c, text)| match c {
            0 => format!("{text:<w$}", w = widths[c]),
            _ => format!("{text:>w$}", w = widths[c]),
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use anyhow::Context;

    #[test]
    fn causes_are_told_once_and_on_one_line() {
        let cause = || std::io::Error::other("no\ndisk");
        let error = anyhow::Error::new(cause()).context("a.png: cannot write");
        assert_eq!(super::on_one_line(&error), "a.png: cannot write: no disk");
        let error = Err::<(), _>(cause()).with_context(|| format!("cannot open: {}", cause())).unwrap_err();
        assert_eq!(super::on_one_line(&error), "cannot open: no disk");
    }

    #[test]
    fn numbers_for_people_are_short() {
        let texts = [1.088_888_888, 0.138_000_339, 1_234_567.0, 12.0, -3e-9, 0.0].map(super::number);
        assert_eq!(texts, ["1.08889", "0.138", "1234567", "12", "-3.00000e-9", "0"]);
    }

    #[test]
    fn tables_align() {
        let rows = [vec!["a".to_owned(), "10".to_owned()], vec!["long".to_owned(), "5".to_owned()]];
        assert_eq!(super::table(&rows), "a     10\nlong   5");
    }
}
