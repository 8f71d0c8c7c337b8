//! Running the binary, and what holds for every run.

use std::{
    path::Path,
    process::{Command, Output},
};

use serde_json::Value;

use crate::files;

/// What a run of the binary left behind.
#[derive(Debug)]
pub struct Ran {
    pub status: i32,
    pub stdout: String,
    pub stderr: String,
}

/// The binary, to be run in a folder.
pub fn command(folder: &Path, line: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_chronoxel"));
    command.current_dir(folder).args(words(line));
    command
}

/// The words of a command line: blanks separate, `'…'` holds together.
fn words(line: &str) -> Vec<String> {
    let mut words = Vec::new();
    for (number, part) in line.split('\'').enumerate() {
        match number % 2 {
            0 => words.extend(part.split_whitespace().map(str::to_owned)),
            _ => words.push(part.to_owned()),
        }
    }
    words
}

/// Runs a command line. Whatever happens, it must not panic.
pub fn run(folder: &Path, line: &str) -> Ran {
    let output = command(folder, line).output().unwrap();
    Ran::new(line, &output)
}

impl Ran {
    pub fn new(line: &str, output: &Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
        let ran = Self {
            status: output.status.code().unwrap_or(-1),
            stdout: text(&output.stdout),
            stderr: text(&output.stderr),
        };
        assert!(!ran.stderr.contains("panicked"), "{line}: {ran:#?}");
        ran
    }
}

/// Runs a command line that must succeed, without a word on stderr.
pub fn done(folder: &Path, line: &str) -> Ran {
    let ran = run(folder, line);
    assert_eq!((ran.status, ran.stderr.as_str()), (0, ""), "{line}: {ran:#?}");
    ran
}

/// Runs a command line with `--json`: it must succeed and print one object on one line.
pub fn json(folder: &Path, line: &str) -> Value {
    let ran = done(folder, &format!("{line} --json"));
    one_object(&ran)
}

/// The one JSON object on stdout.
pub fn one_object(ran: &Ran) -> Value {
    assert_eq!(ran.stdout.matches('\n').count(), 1, "{ran:#?}");
    let value: Value = serde_json::from_str(&ran.stdout).unwrap_or_else(|e| panic!("{e}: {ran:#?}"));
    assert!(value.is_object(), "{ran:#?}");
    value
}

/// Runs a command line that must fail with status 1 and one line that has some words in it, leaving the folder as it
/// was.
pub fn refused(folder: &Path, line: &str, says: &[&str]) -> Ran {
    let before = files::tree(folder);
    let ran = run(folder, line);
    assert_eq!(ran.status, 1, "{line}: {ran:#?}");
    assert_eq!(ran.stdout, "", "{line}: {ran:#?}");
    assert!(ran.stderr.starts_with("chronoxel: error: ") && ran.stderr.ends_with('\n'), "{line}: {ran:#?}");
    assert_eq!(ran.stderr.matches('\n').count(), 1, "one line: {line}: {ran:#?}");
    for word in says {
        assert!(ran.stderr.contains(word), "no {word:?} in {line}: {ran:#?}");
    }
    let after = files::tree(folder);
    assert!(before == after, "{line:?} left {:?} of {:?}", after.keys(), before.keys());
    ran
}

/// A member of a JSON object by its path `a.b.c`; it must be there.
#[track_caller]
pub fn at<'a>(value: &'a Value, path: &str) -> &'a Value {
    path.split('.').fold(value, |value, key| {
        value.get(key).unwrap_or_else(|| panic!("no {key:?} of {path:?} in {value}"))
    })
}

/// As [`at`], a number.
#[track_caller]
pub fn number(value: &Value, path: &str) -> f64 {
    let found = at(value, path);
    found.as_f64().unwrap_or_else(|| panic!("{path:?} is {found}, not a number"))
}
