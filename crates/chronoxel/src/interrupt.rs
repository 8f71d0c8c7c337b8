//! What Ctrl-C does: an output under way is removed first, and the exit status is 130.
//!
//! Work that writes under temporary names holds a [`CleanUp`] and asks [`check`] between its parts; everything else
//! ends at once, since what it writes is whole at any moment. A second Ctrl-C ends the program whatever it does.

use std::{
    fmt,
    sync::{Mutex, MutexGuard, PoisonError},
};

/// The exit status of a program that Ctrl-C ended: 128 and the number of the signal.
pub const EXIT_STATUS: u8 = 130;

#[derive(Debug)]
struct State {
    interrupted: bool,
    /// How many outputs are under way that must be removed.
    num_clean_ups: usize,
    /// What the user can do with what is there.
    advice: Option<String>,
}

static STATE: Mutex<State> = Mutex::new(State { interrupted: false, num_clean_ups: 0, advice: None });

fn state() -> MutexGuard<'static, State> {
    STATE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The error of work that was interrupted.
#[derive(Debug)]
struct Interrupted;

impl fmt::Display for Interrupted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("interrupted")
    }
}

impl std::error::Error for Interrupted {}

/// Installs the handler of Ctrl-C. Where there cannot be one, Ctrl-C ends the program as it always did.
pub fn install() {
    let _ = ctrlc::set_handler(|| {
        let mut state = state();
        let again = std::mem::replace(&mut state.interrupted, true);
        if again || state.num_clean_ups == 0 {
            say(&state);
            std::process::exit(i32::from(EXIT_STATUS));
        }
    });
}

fn say(state: &State) {
    let advice = state.advice.as_ref().map(|advice| format!(": {advice}"));
    eprintln!("chronoxel: interrupted{}", advice.unwrap_or_default());
}

/// Says that the program was interrupted; whether it was.
pub fn told() -> bool {
    let state = state();
    if state.interrupted {
        say(&state);
    }
    state.interrupted
}

/// An error once Ctrl-C was pressed.
///
/// # Errors
/// If it was.
pub fn check() -> anyhow::Result<()> {
    if state().interrupted { Err(Interrupted.into()) } else { Ok(()) }
}

/// While it lives, Ctrl-C waits for the next [`check`].
#[derive(Debug)]
pub struct CleanUp(());

impl CleanUp {
    /// Work begins that has something to remove when it is interrupted.
    pub fn begin() -> Self {
        state().num_clean_ups += 1;
        Self(())
    }
}

impl Drop for CleanUp {
    fn drop(&mut self) {
        state().num_clean_ups -= 1;
    }
}

/// While it lives, an interruption gives this advice.
#[derive(Debug)]
pub struct Advice(());

impl Advice {
    /// What to tell the user who interrupts what begins now.
    pub fn begin(advice: String) -> Self {
        state().advice = Some(advice);
        Self(())
    }
}

impl Drop for Advice {
    fn drop(&mut self) {
        state().advice = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_interrupted_unless_it_is() {
        let (_clean_up, _advice) = (CleanUp::begin(), Advice::begin("go on".into()));
        assert!(state().num_clean_ups >= 1);
        assert_eq!(state().advice.as_deref(), Some("go on"));
        assert!(check().is_ok() && !told());
        state().interrupted = true;
        assert_eq!(check().unwrap_err().to_string(), "interrupted");
        state().interrupted = false;
    }
}
