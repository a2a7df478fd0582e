//! Is the service ready? Each thing that must come up holds a latch; when the last is dropped, it is. What fails later
//! takes readiness away for good.

use std::{
    collections::BTreeSet,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

#[derive(Debug, Clone, Default)]
pub struct Readiness {
    missing: Arc<Mutex<BTreeSet<String>>>,
}

/// Dropped when the thing is up.
#[derive(Debug)]
pub struct Latch {
    readiness: Readiness,
    name: &'static str,
}

impl Readiness {
    pub fn latch(&self, name: &'static str) -> Latch {
        self.lock().insert(name.to_owned());
        Latch {
            readiness: self.clone(),
            name,
        }
    }

    pub fn fail(&self, what: String) {
        self.lock().insert(what);
    }

    /// What is not up; nothing when ready.
    pub fn missing(&self) -> Vec<String> {
        self.lock().iter().cloned().collect()
    }

    fn lock(&self) -> MutexGuard<'_, BTreeSet<String>> {
        // A set of names is never left half changed.
        self.missing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Latch {
    fn drop(&mut self) {
        self.readiness.lock().remove(self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ready_when_the_last_latch_is_dropped_and_never_after_a_failure() {
        let readiness = Readiness::default();
        let session = readiness.latch("session");
        let http = readiness.latch("http");
        drop(session);
        assert_eq!(readiness.missing(), ["http"]);
        drop(http);
        assert!(readiness.missing().is_empty());
        readiness.fail("worker of lab".to_owned());
        drop(readiness.latch("late"));
        assert_eq!(readiness.missing(), ["worker of lab"]);
    }
}
