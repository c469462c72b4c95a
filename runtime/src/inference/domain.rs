//! The inference thread: what it loads, what that takes, and what is switched off.

use super::client::{LearnedDepth, LearnedMatcher, Link};
use super::dense::CoarseToFine;
use super::depth::DepthNetwork;
use super::mailbox::{Mailbox, Question, Sheet};
use super::manifest::Manifest;
use super::pair::PairNetwork;
use super::picture::Picture;
use super::sparse::Keypoints;
use super::two_views::TwoViews;
use super::{Counts, Domain, ModelError, Wanted};
use crate::seal;
use crate::settings::Matcher;
use kilogs_core::correspondence::PixelMatch;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, mpsc};
use std::time::Instant;

/// What the thread has loaded; each part is there only if it was wanted, could be loaded and is within the cap.
#[derive(Debug, Default)]
struct Services {
    sparse: Option<TwoViews<Keypoints>>,
    dense: Option<Dense>,
    depth: Option<DepthNetwork>,
}

/// Dense matching: both images at once where the manifest has a network for that, else grids of features.
#[derive(Debug)]
enum Dense {
    Pair(PairNetwork),
    Grids(TwoViews<CoarseToFine>),
}

/// Which parts there are.
#[derive(Debug, Clone, Copy, Default)]
struct Loaded {
    sparse: bool,
    dense: bool,
    depth: bool,
}

/// Loads what is wanted, runs everything once, and hands out what works.
pub(super) fn open(wanted: &Wanted<'_>) -> Result<Domain, ModelError> {
    let manifest = Manifest::find(&wanted.settings.models)?;
    let (width, height) = wanted.image;
    let picture = Picture { pixels: vec![0; width * height], width, height };
    let sheet = Sheet {
        question: Question::Sparse,
        keyframe_ordinal: 0,
        keyframe: picture.clone(),
        current: picture,
        matches: Vec::with_capacity(wanted.capacity),
        pixels: Vec::with_capacity(wanted.capacity),
        depths_m: Vec::with_capacity(wanted.capacity),
    };
    let (mailbox, counts) = (Arc::new(Mailbox::new(sheet)), Arc::new(Counts::default()));
    let (tell, opened) = mpsc::channel();
    let thread = {
        let (mailbox, counts, wanted) = (Arc::clone(&mailbox), Arc::clone(&counts), OwnedWanted::of(wanted));
        let work = move || inference_thread(&mailbox, &counts, &manifest, &wanted, &tell);
        std::thread::Builder::new().name("inference".to_owned()).spawn(work).map_err(ModelError::NoThread)?
    };
    let loaded: Loaded = opened.recv().unwrap_or_default();
    let patience = wanted.is_live.then_some(wanted.settings.deadline);
    let link = Arc::new(Link { mailbox, counts: Arc::clone(&counts), patience, thread: Some(thread) });
    let matcher = |question| LearnedMatcher::new(Arc::clone(&link), question, wanted.capacity);
    Ok(Domain {
        sparse: loaded.sparse.then(|| Box::new(matcher(Question::Sparse)) as _),
        dense: loaded.dense.then(|| Box::new(matcher(Question::Dense)) as _),
        depth: loaded.depth.then(|| Box::new(LearnedDepth::new(Arc::clone(&link))) as _),
        counts,
    })
}

/// [`Wanted`] without borrowed parts.
struct OwnedWanted {
    matcher: Matcher,
    dense: bool,
    depth: bool,
    focal_px: f32,
    image: ((usize, usize), usize),
    cap_bytes: u64,
    capacity: usize,
}

impl OwnedWanted {
    fn of(wanted: &Wanted<'_>) -> Self {
        Self {
            matcher: wanted.matcher,
            dense: wanted.dense,
            depth: wanted.depth,
            focal_px: wanted.focal_px,
            image: (wanted.image, wanted.settings.max_width_px),
            cap_bytes: wanted.cap_bytes,
            capacity: wanted.capacity,
        }
    }
}

fn inference_thread(
    mailbox: &Mailbox,
    counts: &Counts,
    manifest: &Manifest,
    wanted: &OwnedWanted,
    tell: &mpsc::Sender<Loaded>,
) {
    let closing = Closing(mailbox);
    let mut services = Services::load(manifest, wanted, counts);
    let loaded =
        Loaded { sparse: services.sparse.is_some(), dense: services.dense.is_some(), depth: services.depth.is_some() };
    if tell.send(loaded).is_ok() {
        mailbox.serve(|sheet| services.answer(sheet, wanted.capacity, counts));
    }
    drop(closing);
}

/// Nobody waits for a thread that has ended, however it ended.
struct Closing<'a>(&'a Mailbox);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl Services {
    fn load(manifest: &Manifest, wanted: &OwnedWanted, counts: &Counts) -> Self {
        let picture = trial_picture(wanted.image.0);
        let roles = match wanted.matcher.roles() {
            &[features, glue] => Some((features, glue)),
            _ => None,
        };
        let trial = Trial { counts, cap_bytes: wanted.cap_bytes };
        let sparse = roles.and_then(|roles| {
            let load = || TwoViews::tried(Keypoints::load(manifest, roles, wanted.image)?, &picture);
            trial.of("the learned matcher", load)
        });
        let dense = wanted.dense.then(|| trial.of("dense matching", || Dense::tried(manifest, wanted.image, &picture)));
        let depth = wanted.depth.then(|| {
            trial.of("the depth network", || {
                let loaded = DepthNetwork::load(manifest, wanted.focal_px)?;
                loaded.depths_m(&picture, &[], &mut [])?;
                Ok(loaded)
            })
        });
        Self { sparse, dense: dense.flatten(), depth: depth.flatten() }
    }

    /// Writes the answer on the sheet; none when the networks fail.
    fn answer(&mut self, sheet: &mut Sheet, capacity: usize, counts: &Counts) {
        let Sheet { question, keyframe_ordinal, keyframe, current, matches, pixels, depths_m } = sheet;
        let keyframe = (*keyframe_ordinal, &*keyframe);
        let answered = match (question, &mut self.sparse, &mut self.dense, &self.depth) {
            (Question::Sparse, Some(sparse), _, _) => sparse.match_pair(keyframe, current, matches),
            (Question::Dense, _, Some(dense), _) => dense.match_pair(keyframe, current, matches),
            (Question::Depth, _, _, Some(depth)) => {
                depths_m.clear();
                depths_m.resize(pixels.len(), f32::NAN);
                depth.depths_m(current, pixels, depths_m)
            }
            _ => Ok(()),
        };
        if let Err(error) = answered {
            matches.clear();
            depths_m.clear();
            if counts.failed.fetch_add(1, Relaxed) == 0 {
                log::warn!("{error}");
            }
        }
        matches.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
        matches.truncate(capacity);
        counts.peak_bytes.fetch_max(seal::thread_heap().peak_bytes, Relaxed);
    }
}

impl Dense {
    fn tried(manifest: &Manifest, image: ((usize, usize), usize), picture: &Picture) -> Result<Self, ModelError> {
        match PairNetwork::load(manifest)? {
            Some(network) => {
                network.match_pair(picture, picture, &mut Vec::new())?;
                Ok(Self::Pair(network))
            }
            None => Ok(Self::Grids(TwoViews::tried(CoarseToFine::load(manifest, image)?, picture)?)),
        }
    }

    fn match_pair(
        &mut self,
        keyframe: (u32, &Picture),
        current: &Picture,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError> {
        match self {
            Self::Pair(network) => network.match_pair(keyframe.1, current, matches),
            Self::Grids(networks) => networks.match_pair(keyframe, current, matches),
        }
    }
}

/// Loads a part, runs it once and sees what that took.
struct Trial<'a> {
    counts: &'a Counts,
    cap_bytes: u64,
}

impl Trial<'_> {
    /// The part, or nothing when it cannot be loaded or takes more than the cap; the reason is logged and counted.
    fn of<T>(&self, what: &'static str, load_and_run: impl FnOnce() -> Result<T, ModelError>) -> Option<T> {
        seal::restart_thread_peak();
        let started = Instant::now();
        // What the library does with a strange file is not ours to foresee.
        let loaded = catch_unwind(AssertUnwindSafe(load_and_run)).unwrap_or(Err(ModelError::Panicked { what }));
        let needed = seal::thread_heap().peak_bytes;
        let within_cap = loaded.and_then(|part| match needed > self.cap_bytes {
            true => Err(ModelError::OverCap { what, needed, cap: self.cap_bytes }),
            false => Ok(part),
        });
        match within_cap {
            Ok(part) => {
                self.counts.peak_bytes.fetch_max(needed, Relaxed);
                let (mib, seconds) = (needed >> 20, started.elapsed().as_secs_f32());
                log::info!("{what}: loaded and tried in {seconds:.1} s, {mib} MiB at most");
                Some(part)
            }
            Err(error) => {
                self.counts.switched_off.fetch_add(1, Relaxed);
                log::warn!("{what} is off: {error}");
                None
            }
        }
    }
}

/// Side of the squares of the trial picture, px.
const TRIAL_SQUARE_PX: usize = 8;

/// A picture full of corners, so that networks have as much to do with it as with any.
fn trial_picture((width, height): (usize, usize)) -> Picture {
    let mut rng = kilogs_core::math::Rng::new(0, 0, 0);
    let columns = width.div_ceil(TRIAL_SQUARE_PX);
    let squares: Vec<u8> =
        (0..columns * height.div_ceil(TRIAL_SQUARE_PX)).map(|_| (rng.unit_f32() * 255.0) as u8).collect();
    let at = |i: usize| squares[i / width / TRIAL_SQUARE_PX * columns + i % width / TRIAL_SQUARE_PX];
    Picture { pixels: (0..width * height).map(at).collect(), width, height }
}
