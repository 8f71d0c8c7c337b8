//! The `chronoxel` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    chronoxel::cli::run()
}
