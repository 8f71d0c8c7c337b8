//! What this process used, memory and processor time, and what the system keeps for it.

use std::path::Path;

/// Resources used since the process began.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResourceUsage {
    /// The most memory that was resident at once.
    pub peak_rss_bytes: u64,
    /// Processor time of all threads, user and system.
    pub cpu_secs: f64,
}

/// Asks the operating system; `None` where it cannot tell.
#[cfg(unix)]
pub fn resource_usage() -> Option<ResourceUsage> {
    let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: `getrusage` writes one `rusage` through the pointer, which is valid for it, and
    // `RUSAGE_SELF` is a valid target; zeroed memory is a valid `rusage` in any case.
    let usage = unsafe {
        if libc::getrusage(libc::RUSAGE_SELF, usage.as_mut_ptr()) != 0 {
            return None;
        }
        usage.assume_init()
    };
    let secs = |t: libc::timeval| t.tv_sec as f64 + t.tv_usec as f64 * 1e-6;
    // Linux counts in KiB, macOS in bytes.
    let unit = if cfg!(target_vendor = "apple") { 1 } else { 1024 };
    let peak_rss_bytes = peak_of_this_program().or(u64::try_from(usage.ru_maxrss).ok().map(|n| n * unit))?;
    Some(ResourceUsage { peak_rss_bytes, cpu_secs: secs(usage.ru_utime) + secs(usage.ru_stime) })
}

/// The peak that Linux tells of the program alone: `getrusage` counts what the process that started it had.
#[cfg(unix)]
fn peak_of_this_program() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

/// Asks the operating system; `None` where it cannot tell.
#[cfg(not(unix))]
pub fn resource_usage() -> Option<ResourceUsage> {
    None
}

/// Has large blocks go back to the system as soon as they are freed, which costs some processor time.
///
/// Otherwise the allocator keeps them, per thread: an encoder whose slabs are made by one thread and freed by another was seen to
/// hold two thirds more than it uses.
pub fn return_large_blocks() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: `mallopt` sets a number in the allocator, under its lock; the parameter is one that it knows.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, LARGE_BLOCK_BYTES);
    }
}

/// Bytes that storage delivered for this process since it began, what the system had in memory left out; 0 where the system does not tell.
pub fn device_bytes_read() -> u64 {
    let told = std::fs::read_to_string("/proc/self/io").unwrap_or_default();
    let line = told.lines().find_map(|line| line.strip_prefix("read_bytes:"));
    line.and_then(|bytes| bytes.trim().parse().ok()).unwrap_or(0)
}

/// Has the system forget what it keeps of the files of a folder in memory, as far as they are on disk and it can: the next
/// read of them is one of the disk.
pub fn forget_cached_files(folder: &Path) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => forget_cached_files(&path),
            Ok(kind) if kind.is_file() => forget_cached_file(&path),
            _ => {}
        }
    }
}

#[cfg(target_os = "linux")]
fn forget_cached_file(path: &Path) {
    use std::os::fd::AsRawFd;
    let Ok(file) = std::fs::File::open(path) else { return };
    // What is not on disk yet is not forgotten.
    let _ = file.sync_data();
    // SAFETY: the descriptor is that of a file that is open until the end of this function; the call is advice, which changes
    // no byte of it.
    unsafe {
        libc::posix_fadvise(file.as_raw_fd(), 0, 0, libc::POSIX_FADV_DONTNEED);
    }
}

#[cfg(not(target_os = "linux"))]
fn forget_cached_file(_path: &Path) {}

/// Blocks from this size on are large: slabs and windows of slices, not bricks.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
const LARGE_BLOCK_BYTES: libc::c_int = 512 << 10;

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn touching_memory_raises_the_peak() {
        let before = resource_usage().unwrap();
        let block = std::hint::black_box(vec![1u8; 64 << 20]);
        let sum: u64 = block.iter().step_by(4096).map(|&b| u64::from(b)).sum();
        assert_eq!(sum, 16384);
        let after = resource_usage().unwrap();
        assert!(after.peak_rss_bytes >= 60 << 20);
        assert!(after.cpu_secs >= before.cpu_secs);
    }

    #[test]
    fn forgotten_files_keep_their_bytes() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("inner")).unwrap();
        let file = folder.path().join("inner/file");
        std::fs::write(&file, [7; 70_000]).unwrap();
        forget_cached_files(folder.path());
        assert!(std::fs::read(&file).unwrap() == [7; 70_000]);
        forget_cached_files(&file.join("absent"));
    }
}
/// Keeps Mesa's layer that chooses among GPUs from asking a display for its opinion, and from complaining on stderr, where there is none.
///
/// What a user set stays. Call it before any other thread starts.
pub fn choose_gpus_without_display() {
    let is_unset = |name: &str| std::env::var_os(name).is_none();
    if cfg!(target_os = "linux") && is_unset("XDG_RUNTIME_DIR") && is_unset("NODEVICE_SELECT") {
        // SAFETY: this is the first thing that the process does, and no other thread reads or writes the environment yet.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}
