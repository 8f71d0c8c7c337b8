//! The elements of a VTK XML file and where their text lies, without holding the text.
//!
//! VTK's own subset of XML: elements, attributes, comments and declarations. What `<AppendedData>` holds is often not
//! XML at all, so that scanning stops there.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::volume_file::open_regular;
use crate::SourceError;

/// The longest tag, comment or declaration.
const MAX_TAG_BYTES: usize = 1 << 20;

/// The largest number of elements.
const MAX_ELEMENTS: usize = 1 << 20;

/// The deepest nesting.
const MAX_DEPTH: usize = 64;

/// One element.
#[derive(Debug)]
pub(crate) struct Element {
    pub name: String,
    attributes: Vec<(String, String)>,
    /// Index of the element around it.
    pub parent: Option<usize>,
    /// Bytes of the file with the longest run of its own text.
    pub text: Range<u64>,
}

impl Element {
    /// The text of an attribute.
    pub fn get(&self, attribute: &str) -> Option<&str> {
        self.attributes.iter().find(|(name, _)| name == attribute).map(|(_, value)| value.as_str())
    }
}

/// The elements of a file in the order of their tags.
#[derive(Debug)]
pub(crate) struct Document {
    pub path: PathBuf,
    pub file_bytes: u64,
    pub elements: Vec<Element>,
    /// Where appended data begin, behind their underscore.
    pub appended_start: Option<u64>,
}

impl Document {
    /// Scans a file.
    pub fn read(path: &Path) -> Result<Self, SourceError> {
        let (file, file_bytes) = open_regular(path)?;
        let mut document =
            Self { path: path.to_owned(), file_bytes, elements: Vec::new(), appended_start: None };
        let input = BufReader::with_capacity(1 << 16, file);
        Scanner { document: &mut document, input, position: 0, open: Vec::new() }.scan()?;
        Ok(document)
    }

    /// Elements of a name, with their indices.
    pub fn all<'a>(&'a self, name: &'a str) -> impl Iterator<Item = (usize, &'a Element)> {
        self.elements.iter().enumerate().filter(move |(_, element)| element.name == name)
    }

    /// Elements of a name right inside another.
    pub fn children<'a>(
        &'a self,
        parent: usize,
        name: &'a str,
    ) -> impl Iterator<Item = (usize, &'a Element)> {
        self.all(name).filter(move |(_, element)| element.parent == Some(parent))
    }

    /// The root, which must be a `VTKFile` of a type.
    pub fn root(&self, file_type: &str) -> Result<&Element, SourceError> {
        let root = self.elements.first().filter(|e| e.name == "VTKFile");
        let root =
            root.ok_or_else(|| SourceError::corrupt(&self.path, "root", "not VTKFile", "write it with VTK"))?;
        match root.get("type") {
            Some(found) if found == file_type => Ok(root),
            found => {
                let problem = format!("it must be {file_type}");
                Err(SourceError::corrupt(&self.path, "VTKFile type", found.unwrap_or("missing"), problem))
            }
        }
    }
}

/// Where scanning stands.
struct Scanner<'a> {
    document: &'a mut Document,
    input: BufReader<File>,
    position: u64,
    /// Elements that are not closed yet.
    open: Vec<usize>,
}

impl Scanner<'_> {
    /// Scans to the end, or to the appended data.
    fn scan(mut self) -> Result<(), SourceError> {
        loop {
            let start = self.position;
            let skipped =
                self.input.skip_until(b'<').map_err(|e| SourceError::io(&self.document.path, "read", e))?;
            self.position += skipped as u64;
            if self.input.fill_buf().map_err(|e| SourceError::io(&self.document.path, "read", e))?.is_empty()
            {
                break;
            }
            self.keep_text(start..self.position - 1);
            let tag = self.read_tag()?;
            self.take_tag(&tag)?;
            if self.document.appended_start.is_some() {
                return Ok(());
            }
        }
        match self.open.last() {
            Some(&index) => {
                let name = format!("</{}>", self.document.elements[index].name);
                Err(self.corrupt(name, "missing", "the file is truncated"))
            }
            None => Ok(()),
        }
    }

    fn corrupt(&self, field: impl Into<String>, value: impl ToString, problem: &str) -> SourceError {
        SourceError::corrupt(&self.document.path, field, value, problem)
    }

    /// Gives text to the element that it is in, if it has no longer one.
    fn keep_text(&mut self, text: Range<u64>) {
        if let Some(&index) = self.open.last() {
            let kept = &mut self.document.elements[index].text;
            if text.end - text.start > kept.end - kept.start {
                *kept = text;
            }
        }
    }

    /// The bytes of a tag behind its `<`, up to its `>`.
    fn read_tag(&mut self) -> Result<Vec<u8>, SourceError> {
        let mut tag = Vec::new();
        let mut quote = None;
        loop {
            let available =
                self.input.fill_buf().map_err(|e| SourceError::io(&self.document.path, "read", e))?;
            if available.is_empty() {
                return Err(self.corrupt(
                    "tag",
                    String::from_utf8_lossy(&tag),
                    "it has no end; the file is truncated",
                ));
            }
            let mut end = None;
            for (i, &byte) in available.iter().enumerate() {
                match (quote, byte) {
                    (Some(open), _) if open == byte => quote = None,
                    (None, b'"' | b'\'') if !tag.starts_with(b"!--") => quote = Some(byte),
                    (None, b'>') if !tag.starts_with(b"!--") || tag.ends_with(b"--") => end = Some(i),
                    _ => {}
                }
                if end.is_some() {
                    break;
                }
                tag.push(byte);
            }
            let taken = end.map_or(available.len(), |i| i + 1);
            self.input.consume(taken);
            self.position += taken as u64;
            if end.is_some() {
                return Ok(tag);
            }
            if tag.len() > MAX_TAG_BYTES {
                return Err(self.corrupt("tag", String::from_utf8_lossy(&tag), "it has no end within 1 MiB"));
            }
        }
    }

    /// Opens or closes an element.
    fn take_tag(&mut self, tag: &[u8]) -> Result<(), SourceError> {
        let text = std::str::from_utf8(tag)
            .map_err(|_| self.corrupt("tag", String::from_utf8_lossy(tag), "it is not UTF-8"))?;
        if text.starts_with(['!', '?']) {
            return Ok(());
        }
        if let Some(name) = text.strip_prefix('/') {
            let open = self.open.pop().map(|index| self.document.elements[index].name.as_str());
            if open != Some(name.trim()) {
                return Err(self.corrupt(
                    format!("</{name}>"),
                    "closing another element",
                    "the file is damaged",
                ));
            }
            return Ok(());
        }
        let (text, is_closed) = match text.strip_suffix('/') {
            Some(text) => (text, true),
            None => (text, false),
        };
        let (name, attributes) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
        if name.is_empty() || self.open.len() >= MAX_DEPTH || self.document.elements.len() >= MAX_ELEMENTS {
            return Err(self.corrupt("tag", text, "not what a VTK file has, or too many of them"));
        }
        let attributes = split_attributes(attributes)
            .ok_or_else(|| self.corrupt("tag", text, "its attributes must read name=\"value\""))?;
        let index = self.document.elements.len();
        let here = self.position..self.position;
        let parent = self.open.last().copied();
        self.document.elements.push(Element { name: name.to_owned(), attributes, parent, text: here });
        if name == "AppendedData" && !is_closed {
            return self.find_appended();
        }
        if !is_closed {
            self.open.push(index);
        }
        Ok(())
    }

    /// Finds the underscore that appended data begin with.
    fn find_appended(&mut self) -> Result<(), SourceError> {
        let skipped =
            self.input.skip_until(b'_').map_err(|e| SourceError::io(&self.document.path, "read", e))?;
        self.position += skipped as u64;
        if self.position > self.document.file_bytes || skipped == 0 {
            return Err(self.corrupt("AppendedData", "empty", "the file is truncated"));
        }
        self.document.appended_start = Some(self.position);
        Ok(())
    }
}

/// The attributes of a tag; `None` if they are not well formed.
fn split_attributes(mut text: &str) -> Option<Vec<(String, String)>> {
    let mut attributes = Vec::new();
    loop {
        text = text.trim_start();
        if text.is_empty() {
            return Some(attributes);
        }
        let (name, rest) = text.split_once('=')?;
        let rest = rest.trim_start();
        let quote = rest.chars().next().filter(|c| matches!(c, '"' | '\''))?;
        let (value, rest) = rest[1..].split_once(quote)?;
        attributes.push((name.trim().to_owned(), unescaped(value)));
        text = rest;
    }
}

/// Text with the five entities of XML and numbered characters replaced.
fn unescaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, after)) = rest.split_once('&') {
        out.push_str(before);
        let (entity, tail) = after.split_once(';').unwrap_or(("", after));
        let number = entity.strip_prefix("#x").map(|hex| u32::from_str_radix(hex, 16));
        let number = number.or_else(|| entity.strip_prefix('#').map(str::parse)).and_then(Result::ok);
        let replaced = match entity {
            "lt" => Some('<'),
            "gt" => Some('>'),
            "amp" => Some('&'),
            "quot" => Some('"'),
            "apos" => Some('\''),
            _ => number.and_then(char::from_u32),
        };
        match replaced {
            Some(c) => {
                out.push(c);
                rest = tail;
            }
            None => {
                out.push('&');
                rest = after;
            }
        }
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn document(text: &[u8]) -> Result<Document, SourceError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.vti");
        std::fs::write(&path, text).unwrap();
        Document::read(&path)
    }

    #[test]
    fn elements_attributes_and_text_are_found() {
        let text = b"<?xml version='1.0'?><!-- <a> it's > --><A x='1' y=\"&lt;&#65;&amp;b&quot;\">\n<B/> hello <C>1</C></A>";
        let document = document(text).unwrap();
        let names: Vec<&str> = document.elements.iter().map(|e| e.name.as_str()).collect();
        assert_eq!(names, ["A", "B", "C"]);
        let a = &document.elements[0];
        assert_eq!((a.get("x"), a.get("y"), a.get("z")), (Some("1"), Some("<A&b\""), None));
        assert_eq!(&text[a.text.start as usize..a.text.end as usize], b" hello ");
        assert_eq!(document.elements[2].parent, Some(0));
    }

    #[test]
    fn what_is_appended_is_not_scanned() {
        let text = b"<A><AppendedData encoding='raw'>\n  _<<\xff\x00>'</AppendedData></A>";
        let document = document(text).unwrap();
        assert_eq!(text[document.appended_start.unwrap() as usize..][..2], *b"<<");
    }

    #[test]
    fn broken_files_are_refused() {
        for text in
            ["<A>", "<A></B>", "<A x=1></A>", "<A", "<A><AppendedData>", "</A>", "<A x=\"></A>", "<!-- >"]
        {
            assert!(document(text.as_bytes()).is_err(), "{text}");
        }
    }
}
