//! The threads that computations share, as long as there are more of them than computations.

use std::{
    ops::Deref,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use rayon::ThreadPool;

/// Every clone is the same pool.
#[derive(Debug, Clone)]
pub struct Pool {
    threads: Arc<ThreadPool>,
    computing: Arc<AtomicUsize>,
}

impl From<Arc<ThreadPool>> for Pool {
    fn from(threads: Arc<ThreadPool>) -> Self {
        Self {
            threads,
            computing: Arc::default(),
        }
    }
}

impl Deref for Pool {
    type Target = ThreadPool;

    fn deref(&self) -> &ThreadPool {
        &self.threads
    }
}

impl Pool {
    /// Counts as a computation as long as the guard is kept.
    pub fn begin(&self) -> Computing {
        // Only a hint to whoever looks: nothing is made visible by it.
        self.computing.fetch_add(1, Ordering::Relaxed);
        Computing(self.computing.clone())
    }

    /// Whether there are as many computations as threads. None is shared out then: the other threads have enough to do,
    /// and to hand work over and back takes longer than some strips.
    pub fn is_taken(&self) -> bool {
        self.computing().max(1) >= self.current_num_threads()
    }

    /// Whether there are more. They take turns at the threads then, so that each is done sooner and finds what it had in
    /// the caches. With one thread every computation keeps to its own.
    pub fn is_crowded(&self) -> bool {
        let threads = self.current_num_threads();
        threads > 1 && self.computing() > threads
    }

    fn computing(&self) -> usize {
        self.computing.load(Ordering::Relaxed)
    }
}

#[derive(Debug)]
pub struct Computing(Arc<AtomicUsize>);

impl Drop for Computing {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}
