//! Names of numbered pictures: `f/{frame:04}.png`.

use anyhow::{Result, bail};

use super::Frame;

/// A file name with fields: `{frame}` counts the pictures from 0, `{step}` is the time step and
/// `{time}` the time. `{frame:04}` pads with zeros to four digits, `{time:.3}` writes three decimals.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameTemplate {
    parts: Vec<Part>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Part {
    Text(String),
    Number { field: Field, width: usize },
    Time { decimals: Option<usize> },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Field {
    Frame,
    Step,
}

impl FrameTemplate {
    /// Whether a name was meant as a template.
    pub fn is_template(name: &str) -> bool {
        name.contains(['{', '}'])
    }

    /// Reads a template.
    ///
    /// # Errors
    /// If no field is in it, a brace is unpaired, or a field is not known.
    pub fn parse(name: &str) -> Result<Self> {
        let mut parts = Vec::new();
        let mut rest = name;
        while let Some(start) = rest.find(['{', '}']) {
            let (text, from_brace) = rest.split_at(start);
            let Some(end) = from_brace.find('}').filter(|end| *end > 0) else {
                bail!("output name '{name}' has an unpaired brace: write a field like {{frame:04}}");
            };
            if !text.is_empty() {
                parts.push(Part::Text(text.to_owned()));
            }
            let Some(part) = field(&from_brace[1..end]) else {
                bail!(
                    "output name '{name}' has the unknown field {}: use {{frame:04}}, {{step}} or {{time:.3}}",
                    &from_brace[..=end]
                );
            };
            parts.push(part);
            rest = &from_brace[end + 1..];
        }
        if parts.is_empty() {
            bail!(
                "output name '{name}' has no field, so every picture would overwrite the last: write '{{frame:04}}.png'"
            );
        }
        if !rest.is_empty() {
            parts.push(Part::Text(rest.to_owned()));
        }
        Ok(Self { parts })
    }

    /// The name of picture number `index`.
    pub fn name(&self, index: usize, frame: &Frame<'_>) -> String {
        let written = |part: &Part| match part {
            Part::Text(text) => text.clone(),
            Part::Number { field: Field::Frame, width } => format!("{index:0width$}"),
            Part::Number { field: Field::Step, width } => format!("{:0width$}", frame.step),
            Part::Time { decimals: Some(decimals) } => format!("{:.decimals$}", frame.time),
            Part::Time { decimals: None } => frame.time.to_string(),
        };
        self.parts.iter().map(written).collect()
    }
}

/// The field between two braces: `frame`, `step:05`, `time:.2`.
fn field(text: &str) -> Option<Part> {
    let (name, format) = text.split_once(':').unwrap_or((text, ""));
    let number = |digits: &str| match digits {
        "" => Some(0),
        digits if digits.bytes().all(|b| b.is_ascii_digit()) => digits.parse().ok().filter(|n| *n <= 20),
        _ => None,
    };
    match name {
        "frame" => Some(Part::Number { field: Field::Frame, width: number(format)? }),
        "step" => Some(Part::Number { field: Field::Step, width: number(format)? }),
        "time" if format.is_empty() => Some(Part::Time { decimals: None }),
        "time" => Some(Part::Time { decimals: Some(number(format.strip_prefix('.')?)?) }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::movie::tests::picture;

    #[test]
    fn fields_are_filled_in() {
        let image = picture(2, 2, 0);
        let frame = Frame { image: &image, step: 40, time: 2.5 };
        let name = |template: &str| FrameTemplate::parse(template).unwrap().name(7, &frame);
        assert_eq!(name("f/{frame:04}.png"), "f/0007.png");
        assert_eq!(name("{frame}.png"), "7.png");
        assert_eq!(name("a{step:3}b{time}c{time:.3}.png"), "a040b2.5c2.500.png");
    }

    #[test]
    fn templates_that_make_no_sense_are_refused() {
        for bad in [
            "f.png",
            "{frame",
            "frame}",
            "{}",
            "{number}.png",
            "{frame:x}",
            "{time:3}",
            "{frame:99999}",
            "}{",
        ] {
            let error = FrameTemplate::parse(bad).unwrap_err().to_string();
            assert!(error.contains(bad) && error.contains("{frame:04}") && !error.contains('\n'), "{error}");
        }
    }
}
