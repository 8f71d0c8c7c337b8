//! Reading and entropy decoding, on threads of its own: the thread that draws never waits for a disk unless it wants to.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::Context;
use chronoxel_core::SpanRecord;
use chronoxel_store::{Store, StoreError};

use crate::session::{Held, HeldKey, read_held};

/// Something to read.
#[derive(Debug)]
pub enum Job {
    /// The spans of a level that hold a step.
    Spans { level: u8, step: u32 },
    /// What is stored of spans of one level.
    Held { level: u8, wanted: Vec<(HeldKey, SpanRecord)> },
}

/// What became of a job; one for each span that was wanted.
#[derive(Debug)]
pub enum Answer {
    /// The spans of a level.
    Spans { level: u8, step: u32, spans: Result<Vec<SpanRecord>, StoreError> },
    /// A payload, a mask.
    Held { key: HeldKey, held: Result<Held, StoreError> },
}

/// Threads that read a store.
pub struct Loader {
    shared: Arc<Shared>,
    answers: Receiver<Answer>,
    threads: Vec<JoinHandle<()>>,
}

/// What the threads share.
struct Shared {
    store: Arc<Store>,
    variable: usize,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    jobs: VecDeque<Job>,
    is_closed: bool,
    throttle: Option<Throttle>,
}

/// A limit of bytes per second: a debt is slept off by the thread that made it.
struct Throttle {
    bytes_per_sec: f64,
    counted_bytes: u64,
    free_at: Instant,
}

impl Throttle {
    /// When the next read may begin, after reads up to `total_bytes` of the store.
    fn after(&mut self, total_bytes: u64, now: Instant) -> Instant {
        let new_bytes = total_bytes.saturating_sub(self.counted_bytes);
        self.counted_bytes = self.counted_bytes.max(total_bytes);
        // A day is as good as for ever.
        let secs = (new_bytes as f64 / self.bytes_per_sec).min(86_400.0);
        self.free_at = self.free_at.max(now) + Duration::try_from_secs_f64(secs).unwrap_or_default();
        self.free_at
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next job, once there is one; `None` at the end.
    fn next_job(&self) -> Option<Job> {
        let mut state = self.lock();
        loop {
            if state.is_closed {
                return None;
            }
            if let Some(job) = state.jobs.pop_front() {
                return Some(job);
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Sleeps until the throttle lets the next read begin, or the end comes.
    fn rest(&self) {
        let mut state = self.lock();
        let total = self.store.bytes_read();
        let Some(throttle) = &mut state.throttle else { return };
        let until = throttle.after(total, Instant::now());
        while !state.is_closed {
            let Some(left) = until.checked_duration_since(Instant::now()).filter(|d| !d.is_zero()) else {
                return;
            };
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn run(&self, job: Job, answers: &Sender<Answer>) {
        // Nobody hears the answers any more when the loader is being dropped.
        match job {
            Job::Spans { level, step } => {
                let spans = self.store.spans(self.variable, level, step);
                let _ = answers.send(Answer::Spans { level, step, spans });
            }
            Job::Held { level, wanted } => {
                let records: Vec<SpanRecord> = wanted.iter().map(|(_, record)| *record).collect();
                let read = read_held(&self.store, self.variable, level, &records);
                // The throttle stands before the answers, as a slow disk would.
                self.rest();
                for ((key, _), held) in wanted.into_iter().zip(read) {
                    let _ = answers.send(Answer::Held { key, held });
                }
            }
        }
    }
}

impl Loader {
    /// Starts threads that read `variable` of a store.
    ///
    /// * `bytes_per_sec`: the most that is read, if that is limited
    ///
    /// # Errors
    /// If the system gives no more threads.
    pub fn new(
        store: Arc<Store>,
        variable: usize,
        num_threads: usize,
        bytes_per_sec: Option<f64>,
    ) -> anyhow::Result<Self> {
        let throttle = bytes_per_sec.map(|bytes_per_sec| Throttle {
            bytes_per_sec,
            counted_bytes: store.bytes_read(),
            free_at: Instant::now(),
        });
        let state = Mutex::new(State { throttle, ..State::default() });
        let shared = Arc::new(Shared { store, variable, state, changed: Condvar::new() });
        let (sender, answers) = channel();
        let mut loader = Self { shared, answers, threads: Vec::new() };
        for number in 0..num_threads.max(1) {
            let (shared, sender) = (Arc::clone(&loader.shared), sender.clone());
            let run = move || {
                // Of this thread alone: what would be decoded in parallel is decoded here, and not among the threads that draw.
                let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
                let Ok(_pool) = pool else { return };
                while let Some(job) = shared.next_job() {
                    shared.run(job, &sender);
                }
            };
            let thread = std::thread::Builder::new().name(format!("loader {number}"));
            loader.threads.push(thread.spawn(run).context("no thread to read with")?);
        }
        Ok(loader)
    }

    /// Begins a job; urgent ones come before those that wait.
    pub fn begin(&self, job: Job, is_urgent: bool) {
        let mut state = self.shared.lock();
        match is_urgent {
            true => state.jobs.push_front(job),
            false => state.jobs.push_back(job),
        }
        drop(state);
        // All: the one that is woken may be resting.
        self.shared.changed.notify_all();
    }

    /// Takes jobs back that no thread has begun: spans whose keys `is_withdrawn` says.
    pub fn withdraw(&self, is_withdrawn: &dyn Fn(&HeldKey) -> bool) -> Vec<HeldKey> {
        let mut withdrawn = Vec::new();
        let mut state = self.shared.lock();
        for job in &mut state.jobs {
            if let Job::Held { wanted, .. } = job {
                wanted.retain(|(key, _)| {
                    let goes = is_withdrawn(key);
                    withdrawn.extend(goes.then_some(*key));
                    !goes
                });
            }
        }
        state.jobs.retain(|job| !matches!(job, Job::Held { wanted, .. } if wanted.is_empty()));
        withdrawn
    }

    /// The next answer, if there is one now.
    pub fn try_answer(&self) -> Option<Answer> {
        self.answers.try_recv().ok()
    }

    /// The next answer, waiting for it; `None` after a while without one.
    ///
    /// # Errors
    /// If no thread is left to answer.
    pub fn wait(&self, most: Duration) -> anyhow::Result<Option<Answer>> {
        match self.answers.recv_timeout(most) {
            Ok(answer) => Ok(Some(answer)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => {
                anyhow::bail!("the threads that read the store have ended")
            }
        }
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.shared.lock().is_closed = true;
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // A thread that panicked has said so.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_throttle_lets_pass_what_it_says() {
        let start = Instant::now();
        let mut throttle = Throttle { bytes_per_sec: 1000.0, counted_bytes: 500, free_at: start };
        assert_eq!(throttle.after(1500, start), start + Duration::from_secs(1));
        // A debt grows; time that passed without reading is not saved up.
        assert_eq!(throttle.after(3500, start), start + Duration::from_secs(3));
        let later = start + Duration::from_secs(10);
        assert_eq!(throttle.after(4500, later), later + Duration::from_secs(1));
    }
}
