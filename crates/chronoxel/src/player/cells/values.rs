//! The values of the steps that come next, read and decoded by a thread of its own; for a GPU, which decodes, only read.
//!
//! The thread keeps what is stored of the last two spans, so that going from block to block reads each once, and one array of
//! values for each step that is wanted, no more.

use std::{
    collections::BTreeMap,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use anyhow::{Context, anyhow};
use chronoxel_store::{CellPayload, CellStore};

use crate::session::decode_into;

/// What the thread keeps of spans.
const KEPT_PAYLOADS: usize = 2;

/// The values of a step as they are to be drawn.
#[derive(Debug, Clone)]
pub(super) enum Ready {
    /// One per point.
    Values(Arc<Vec<f32>>),
    /// As they are stored.
    Payload(Arc<CellPayload>),
}

/// What was asked for, or why it cannot be had.
type Answer = Result<Ready, Arc<anyhow::Error>>;

/// A thread that decodes ahead.
pub(super) struct ValueLoader {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// Steps, the most urgent first.
    wanted: Vec<u32>,
    ready: BTreeMap<u32, Answer>,
    /// Arrays of steps that are over, to be filled again.
    spare: Vec<Vec<f32>>,
    payload_bytes: usize,
    peak_bytes: usize,
    is_closed: bool,
}

impl State {
    fn missing(&self) -> Option<u32> {
        self.wanted.iter().copied().find(|step| !self.ready.contains_key(step))
    }

    fn count_bytes(&mut self) {
        let arrays = self.ready.values().map(|answer| match answer {
            Ok(Ready::Values(values)) => values.len(),
            _ => 0,
        });
        let spare = self.spare.iter().map(Vec::capacity);
        let num_bytes = 4 * arrays.chain(spare).sum::<usize>() + self.payload_bytes;
        self.peak_bytes = self.peak_bytes.max(num_bytes);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next step to decode and an array for it, once there is one; `None` at the end.
    fn next_job(&self) -> Option<(u32, Vec<f32>)> {
        let mut state = self.lock();
        loop {
            if state.is_closed {
                return None;
            }
            if let Some(step) = state.missing() {
                return Some((step, state.spare.pop().unwrap_or_default()));
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn put(&self, step: u32, answer: Answer, payload_bytes: usize) {
        let mut state = self.lock();
        // What is not wanted any more when it is ready is not kept.
        if state.wanted.contains(&step) {
            state.ready.insert(step, answer);
        }
        state.payload_bytes = payload_bytes;
        state.count_bytes();
        drop(state);
        self.changed.notify_all();
    }

    /// Sleeps so long, or until the end comes.
    fn rest(&self, until: Instant) {
        let mut state = self.lock();
        while !state.is_closed {
            let Some(left) = until.checked_duration_since(Instant::now()).filter(|d| !d.is_zero()) else {
                return;
            };
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// What the thread holds of a store.
struct Reader {
    store: Arc<CellStore>,
    variable: usize,
    /// The last spans, the newest last.
    payloads: Vec<Arc<CellPayload>>,
    bytes_per_sec: Option<f64>,
    decodes: bool,
}

impl Reader {
    fn make(&mut self, step: u32, mut values: Vec<f32>, shared: &Shared) -> anyhow::Result<Ready> {
        let holds = |payload: &Arc<CellPayload>| (payload.start..payload.start + payload.len).contains(&step);
        let payload = match self.payloads.iter().find(|payload| holds(payload)) {
            Some(payload) => Arc::clone(payload),
            None => self.read(step, shared)?,
        };
        if !self.decodes {
            return Ok(Ready::Payload(payload));
        }
        decode_into(&self.store, &payload, step, &mut values)?;
        Ok(Ready::Values(Arc::new(values)))
    }

    fn read(&mut self, step: u32, shared: &Shared) -> anyhow::Result<Arc<CellPayload>> {
        let (start, before) = (Instant::now(), self.store.bytes_read());
        if self.payloads.len() == KEPT_PAYLOADS {
            self.payloads.remove(0);
        }
        let record = self.store.span_at(self.variable, step)?;
        let payload = self.store.read_span(self.variable, &record)?;
        if let Some(rate) = self.bytes_per_sec {
            // As a slow disk would; a day is as good as for ever.
            let secs = ((self.store.bytes_read() - before) as f64 / rate).min(86_400.0);
            shared.rest(start + Duration::from_secs_f64(secs));
        }
        self.payloads.push(Arc::clone(&payload));
        Ok(payload)
    }

    fn payload_bytes(&self) -> usize {
        self.payloads.iter().map(|payload| payload.num_bytes()).sum()
    }
}

impl ValueLoader {
    /// Starts a thread that reads and decodes a variable of a store.
    ///
    /// * `decodes`: whether it decodes, or only reads
    /// * `bytes_per_sec`: the most that is read, if that is limited
    ///
    /// # Errors
    /// If the system gives no more threads.
    pub fn new(
        store: &Arc<CellStore>,
        variable: usize,
        decodes: bool,
        bytes_per_sec: Option<f64>,
    ) -> anyhow::Result<Self> {
        let shared = Arc::new(Shared { state: Mutex::default(), changed: Condvar::new() });
        let mut reader =
            Reader { store: Arc::clone(store), variable, payloads: Vec::new(), bytes_per_sec, decodes };
        let of_thread = Arc::clone(&shared);
        let run = move || {
            while let Some((step, values)) = of_thread.next_job() {
                let answer = reader.make(step, values, &of_thread).map_err(Arc::new);
                of_thread.put(step, answer, reader.payload_bytes());
            }
        };
        let thread = std::thread::Builder::new().name("decoder".into()).spawn(run);
        Ok(Self { shared, thread: Some(thread.context("no thread to decode with")?) })
    }

    /// Says which steps are wanted, the most urgent first; what is held of others is given up.
    pub fn want(&self, steps: &[u32]) {
        let mut state = self.shared.lock();
        let most_spare = steps.len();
        state.wanted = steps.to_vec();
        let (kept, over) =
            std::mem::take(&mut state.ready).into_iter().partition(|(step, _)| steps.contains(step));
        state.ready = kept;
        let over: BTreeMap<u32, Answer> = over;
        let arrays = over.into_values().filter_map(|answer| match answer {
            Ok(Ready::Values(values)) => Arc::try_unwrap(values).ok(),
            _ => None,
        });
        state.spare.extend(arrays);
        let num_spare = most_spare.saturating_sub(state.ready.len());
        state.spare.truncate(num_spare);
        drop(state);
        self.shared.changed.notify_all();
    }

    /// Whether the values of a step are there, or the error that there is in their place.
    pub fn is_ready(&self, step: u32) -> bool {
        self.shared.lock().ready.contains_key(&step)
    }

    /// What is stored of a step, if it is there and not decoded.
    pub fn payload(&self, step: u32) -> Option<Arc<CellPayload>> {
        match self.shared.lock().ready.get(&step) {
            Some(Ok(Ready::Payload(payload))) => Some(Arc::clone(payload)),
            _ => None,
        }
    }

    /// The values of a step that is wanted, waiting for them.
    ///
    /// # Errors
    /// If they cannot be read or decoded.
    pub fn wait(&self, step: u32) -> anyhow::Result<Ready> {
        let mut state = self.shared.lock();
        loop {
            match state.ready.get(&step) {
                Some(Ok(ready)) => return Ok(ready.clone()),
                Some(Err(error)) => return Err(anyhow!("{error:#}")),
                None if self.thread.as_ref().is_none_or(JoinHandle::is_finished) => {
                    return Err(anyhow!("the thread that decodes has ended"));
                }
                None => {}
            }
            let waited = self.shared.changed.wait_timeout(state, PATIENCE);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// The most bytes held at once.
    pub fn peak_bytes(&self) -> usize {
        self.shared.lock().peak_bytes
    }
}

/// How long to wait for an answer before looking whether one can still come.
const PATIENCE: Duration = Duration::from_millis(200);

impl Drop for ValueLoader {
    fn drop(&mut self) {
        self.shared.lock().is_closed = true;
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has said so.
            let _ = thread.join();
        }
    }
}
