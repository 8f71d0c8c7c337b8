//! The `chronoxel` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    chronoxel::process::choose_gpus_without_display();
    chronoxel::cli::run()
}
