//! Numbered PNGs named by a template.

use std::collections::HashSet;
use std::path::Path;

use anyhow::{Result, bail};

use super::pending::PendingFile;
use super::{Frame, FrameCheck, FrameSink, FrameTemplate, MovieOptions, picture};

/// PNGs being written; they get their names together at the end.
pub(super) struct NumberedPngs {
    template: FrameTemplate,
    check: FrameCheck,
    names: HashSet<String>,
    files: Vec<PendingFile>,
}

impl NumberedPngs {
    pub(super) fn create(output: &str, options: MovieOptions) -> Result<Self> {
        if !output.to_ascii_lowercase().ends_with(".png") {
            bail!(
                "output '{output}' numbers its pictures but does not end in .png: numbered pictures are PNGs"
            );
        }
        let template = FrameTemplate::parse(output)?;
        Ok(Self {
            template,
            check: FrameCheck::new(output, options),
            names: HashSet::new(),
            files: Vec::new(),
        })
    }
}

impl FrameSink for NumberedPngs {
    fn write_frame(&mut self, frame: &Frame<'_>) -> Result<()> {
        let index = self.check.next(frame.image)?;
        let name = self.template.name(index, frame);
        if !self.names.insert(name.clone()) {
            bail!(
                "output '{}' names two pictures '{name}': use {{frame}}, which differs for each",
                self.check.output
            );
        }
        let file = PendingFile::new(Path::new(&name))?;
        picture::encode(frame.image, &file)?;
        self.files.push(file);
        Ok(())
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.check.complete()?;
        self.files.drain(..).try_for_each(PendingFile::publish)
    }
}

impl Drop for NumberedPngs {
    fn drop(&mut self) {
        // The first file made the folders, so it goes last.
        while self.files.pop().is_some() {}
    }
}
