//! The command line: one file per verb; arguments that several share are in `args` and `view`.

mod args;
mod bench;
mod cells;
mod compare;
mod demo;
mod encode;
mod export;
mod info;
mod movie;
mod output;
mod play;
mod render;
mod verify;
mod view;

use std::process::ExitCode;

use anyhow::Context;
use chronoxel_store::{CellStore, Store};
use clap::{Parser, Subcommand};

use args::Common;

use crate::interrupt;

/// Explore time-varying volumes too large for memory: encode once, then look at any time step.
#[derive(Debug, Parser)]
#[command(name = "chronoxel", version, propagate_version = true, arg_required_else_help = true)]
#[command(after_help = "Examples:
  chronoxel demo                                     see what it does, on a built-in simulation
  chronoxel encode 'run/*.vti' -o run.cxl            from files to a store
  chronoxel render run.cxl -t 12 -o step12.png       one picture
  chronoxel movie run.cxl --orbit 90 -o run.gif      many")]
struct Cli {
    #[command(flatten)]
    common: Common,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Demo(demo::DemoArgs),
    Encode(encode::EncodeArgs),
    Info(info::InfoArgs),
    Verify(verify::VerifyArgs),
    Export(export::ExportArgs),
    Render(render::RenderArgs),
    Movie(movie::MovieArgs),
    Play(play::PlayArgs),
    Compare(compare::CompareArgs),
    Bench(bench::BenchArgs),
}

/// Options that contradict each other: as wrong as one that does not exist.
#[derive(Debug)]
struct WrongUsage(String);

impl std::fmt::Display for WrongUsage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for WrongUsage {}

/// Runs the command line of this process. Exit status: 0 done, 1 it failed, 2 wrong usage, 130 interrupted.
pub fn run() -> ExitCode {
    let cli = Cli::parse();
    interrupt::install();
    match dispatch(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(_) if interrupt::told() => ExitCode::from(interrupt::EXIT_STATUS),
        Err(error) if error.is::<WrongUsage>() => {
            eprintln!("error: {error}\n\nFor more information, try '--help'.");
            ExitCode::from(2)
        }
        Err(error) => {
            output::error(&error);
            ExitCode::FAILURE
        }
    }
}

fn dispatch(cli: &Cli) -> anyhow::Result<()> {
    if let Some(threads) = cli.common.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    }
    let common = &cli.common;
    match &cli.verb {
        Verb::Demo(args) => demo::run(common, args),
        Verb::Encode(args) => encode::run(common, args),
        Verb::Info(args) => info::run(common, args),
        Verb::Verify(args) => verify::run(common, args),
        Verb::Export(args) => export::run(common, args),
        Verb::Render(args) => render::run(common, args),
        Verb::Movie(args) => movie::run(common, args),
        Verb::Play(args) => play::run(common, args),
        Verb::Compare(args) => compare::run(common, args),
        Verb::Bench(args) => bench::run(common, args),
    }
}

/// The index of a variable of a store by its name, 0 where none is given.
fn variable_index(store: &Store, name: Option<&str>) -> anyhow::Result<usize> {
    let Some(name) = name else { return Ok(0) };
    let header = store.header();
    header.variable(name).with_context(|| {
        let names: Vec<&str> = header.variables.iter().map(|v| v.name.as_str()).collect();
        format!("{}: no variable {name:?}; it has {}", store.path().display(), names.join(", "))
    })
}

/// The index of a variable of a store of cells by its name, 0 where none is given.
fn cell_variable_index(store: &CellStore, name: Option<&str>) -> anyhow::Result<usize> {
    let Some(name) = name else { return Ok(0) };
    let header = store.header();
    header.variable(name).with_context(|| {
        let names: Vec<&str> = header.variables.iter().map(|v| v.name.as_str()).collect();
        format!("{}: no variable {name:?}; it has {}", store.path().display(), names.join(", "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent_and_every_verb_has_an_example() {
        let mut command = Cli::command();
        command.build();
        command.clone().debug_assert();
        for verb in command.get_subcommands().filter(|verb| verb.get_name() != "help") {
            let help = verb.get_after_help().map(ToString::to_string).unwrap_or_default();
            assert!(help.contains("chronoxel "), "{} has no example in its help", verb.get_name());
        }
    }
}
