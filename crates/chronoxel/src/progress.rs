//! Progress on standard error: a bar with rate and time left on a terminal, silence elsewhere.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// What a progress bar counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Counted {
    /// Bytes, shown in binary units.
    Bytes,
    /// Things with a name, e.g. `steps` or `frames`.
    Items(&'static str),
}

/// A bar that is removed when it is finished or dropped. Clones share one bar, from any thread.
#[derive(Debug, Clone)]
pub struct Progress {
    bar: ProgressBar,
}

impl Progress {
    /// A bar up to `total`, led by `what` (e.g. `encode`). Nothing is drawn when `quiet` is set or
    /// standard error is not a terminal.
    pub fn new(what: &'static str, total: u64, counted: Counted, quiet: bool) -> Self {
        let target = if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
        Self::on(target, what, total, counted)
    }

    fn on(target: ProgressDrawTarget, what: &'static str, total: u64, counted: Counted) -> Self {
        let bar = ProgressBar::with_draw_target(Some(total), target);
        let style = ProgressStyle::with_template(&template(counted)).expect("the templates below are valid");
        bar.set_style(style.progress_chars("━╸─"));
        bar.set_prefix(what);
        Self { bar }
    }

    /// `count` more are done.
    pub fn advance(&self, count: u64) {
        self.bar.inc(count);
    }

    /// `position` of the total are done.
    pub fn set(&self, position: u64) {
        self.bar.set_position(position);
    }

    /// How many are done.
    pub fn position(&self) -> u64 {
        self.bar.position()
    }

    /// Prints a line above the bar; on standard error also where no bar is drawn.
    pub fn warn(&self, line: &str) {
        self.bar.suspend(|| eprintln!("{line}"));
    }

    /// Removes the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// How a bar looks: name, bar, done of total, rate, time left.
fn template(counted: Counted) -> String {
    let counts = match counted {
        Counted::Bytes => "{binary_bytes} of {binary_total_bytes}  {binary_bytes_per_sec}".to_owned(),
        Counted::Items(name) => format!("{{human_pos}} of {{human_len}} {name}  {{per_sec}}"),
    };
    format!("{{prefix}} {{bar:32.cyan/238}} {counts}  {{eta}} left")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_bar_has_a_valid_template() {
        for counted in [Counted::Bytes, Counted::Items("steps")] {
            let progress = Progress::on(ProgressDrawTarget::hidden(), "encode", 10, counted);
            progress.advance(3);
            progress.clone().set(7);
            progress.advance(1);
            assert_eq!(progress.position(), 8);
            progress.finish();
        }
    }

    #[test]
    fn nothing_is_drawn_when_quiet() {
        let progress = Progress::new("encode", 10, Counted::Bytes, true);
        assert!(progress.bar.is_hidden());
    }
}
