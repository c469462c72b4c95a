//! The page directory: where the keyframes of each page are, what is in memory of them, and what is on disk.

use super::mapper::CHUNK_KEYFRAMES;
use super::realign::moved_placement;
use crate::splat::KeyframePlacement;
use kilogs_core::conventions::{Rigid, Similarity};
use kilogs_core::map::quota::RouteMeasure;
use nalgebra::{Point3, Translation3, Vector3};

/// Consecutive keyframes whose anchors leave and come back together.
pub const PAGE_KEYFRAMES: u32 = 10;
/// Most page files of these keyframes.
pub const MAX_PARTS: u8 = 64;
/// Where most of what a keyframe spawned is: so far in front of it, and so far around that place, m.
const CONTENT_REACH_M: f64 = 15.0;
/// A page that is seen from its back counts as this much farther away.
const TURNED_FACTOR: f64 = 1.5;
/// A page that is out of view counts as this much farther away.
const HIDDEN_FACTOR: f64 = 1.25;
/// A shorter step tells nothing about where the vehicle is going, m.
const MIN_STEP_M: f64 = 0.05;

/// Keyframes whose anchors leave and come back together; what of them is in memory and what on disk.
#[derive(Debug, Clone, Copy)]
pub struct PageGroup {
    /// First keyframe by [`PAGE_KEYFRAMES`].
    pub(super) group: u32,
    /// Anchors on disk.
    pub(super) n_stored: u32,
    /// How many times pages of it were written.
    pub(super) revision: u32,
    /// It has rows in the backend's tables.
    pub(super) is_resident: bool,
    /// It wanted to come back at this keyframe and found no room.
    pub(super) is_denied: bool,
    /// That was counted, since it was in memory last.
    pub(super) is_denial_counted: bool,
    /// Its page files.
    pub(super) parts: Parts,
    /// Sum over the anchors that came from disk, as they came.
    pub(super) fingerprint: u64,
    placed: u16,
    placements: [KeyframePlacement; PAGE_KEYFRAMES as usize],
}

/// The page files of a group, one bit each.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Parts {
    /// On disk.
    pub(super) stored: u64,
    /// On disk and in memory.
    pub(super) arrived: u64,
    /// On their way into memory.
    pub(super) coming: u64,
    /// Damaged or gone: never asked for again.
    pub(super) lost: u64,
}

impl Parts {
    /// The first that could be asked for.
    pub(super) fn missing(&self) -> Option<u8> {
        let missing = self.stored & !(self.arrived | self.coming | self.lost);
        (missing != 0).then(|| missing.trailing_zeros() as u8)
    }

    /// The first that no page has taken.
    pub(super) fn unused(&self) -> Option<u8> {
        let first = (!self.stored).trailing_zeros() as u8;
        (first < MAX_PARTS).then_some(first)
    }
}

/// Group and part of a page.
pub(super) fn group_and_part(page_id: u32) -> (u32, u8) {
    (page_id / u32::from(MAX_PARTS), (page_id % u32::from(MAX_PARTS)) as u8)
}

impl PageGroup {
    fn new(group: u32) -> Self {
        Self {
            group,
            n_stored: 0,
            revision: 0,
            is_resident: false,
            is_denied: false,
            is_denial_counted: false,
            parts: Parts::default(),
            fingerprint: 0,
            placed: 0,
            placements: [KeyframePlacement::identity(); PAGE_KEYFRAMES as usize],
        }
    }

    /// Id of one of its pages.
    pub(super) fn page_id(&self, part: u8) -> u32 {
        self.group * u32::from(MAX_PARTS) + u32::from(part)
    }

    /// Chunk of its keyframes.
    pub(super) fn chunk(&self) -> u32 {
        self.group * PAGE_KEYFRAMES / CHUNK_KEYFRAMES
    }

    /// Its keyframes, each with its place.
    pub(super) fn keyframes(&self) -> impl Iterator<Item = (u32, &KeyframePlacement)> {
        let first = self.group * PAGE_KEYFRAMES;
        (first..).zip(&self.placements).filter(move |(ordinal, _)| self.placed & (1 << (ordinal - first)) != 0)
    }

    /// Place of one of its keyframes.
    pub(super) fn placement(&self, ordinal: u32) -> Option<&KeyframePlacement> {
        let nth = ordinal.checked_sub(self.group * PAGE_KEYFRAMES).filter(|nth| *nth < PAGE_KEYFRAMES)?;
        self.placements.get(nth as usize).filter(|_| self.placed & (1 << nth) != 0)
    }

    /// Newest of its keyframes.
    pub(super) fn last_ordinal(&self) -> u32 {
        self.group * PAGE_KEYFRAMES + self.placed.checked_ilog2().unwrap_or(0)
    }

    /// Moves each of its keyframes.
    pub(super) fn move_keyframes(&mut self, moved: impl Fn(u32) -> Similarity) {
        let ordinals = self.group * PAGE_KEYFRAMES..;
        for (ordinal, placement) in ordinals.zip(&mut self.placements) {
            *placement = moved_placement(&moved(ordinal), placement);
        }
    }

    fn place(&mut self, ordinal: u32, placement: &KeyframePlacement) {
        let nth = (ordinal % PAGE_KEYFRAMES) as usize;
        self.placements[nth] = *placement;
        self.placed |= 1 << nth;
    }

    /// Way to its nearest keyframe, m.
    pub(super) fn distance_m(&self, position_m: &Vector3<f64>) -> f64 {
        self.keyframes().map(|(_, at)| (at.translation_m - position_m).norm()).fold(f64::INFINITY, f64::min)
    }

    /// How little it matters to who stands at a viewpoint and drives on, m: the way to it from here or from where the
    /// vehicle will be, longer when it shows other sides of things or is out of view.
    pub(super) fn remoteness_m(&self, viewpoint: &Viewpoint) -> f64 {
        let from_ahead_m = self.distance_m(&viewpoint.ahead_m);
        let nearest_m = self.distance_m(&viewpoint.position_m).min(from_ahead_m);
        let (center_m, forward) = self.content();
        let alike = 0.5 + 0.5 * forward.dot(&viewpoint.forward);
        let turned = TURNED_FACTOR + (1.0 - TURNED_FACTOR) * alike;
        let hidden = if viewpoint.sees(&center_m, CONTENT_REACH_M) { 1.0 } else { HIDDEN_FACTOR };
        nearest_m * turned * hidden
    }

    /// Where most of its anchors are, and the direction from which they were seen.
    fn content(&self) -> (Vector3<f64>, Vector3<f64>) {
        let (mut center_m, mut forward, mut n) = (Vector3::zeros(), Vector3::zeros(), 0.0);
        for (_, at) in self.keyframes() {
            center_m += at.translation_m;
            forward += at.rotation * Vector3::z();
            n += 1.0;
        }
        let forward = forward.try_normalize(f64::EPSILON).unwrap_or_default();
        (center_m / f64::max(n, 1.0) + forward * CONTENT_REACH_M, forward)
    }
}

/// Where the vehicle is, what its camera looks at, and where it goes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Viewpoint {
    pub(super) position_m: Vector3<f64>,
    /// Optical axis, in the map.
    forward: Vector3<f64>,
    /// Where it will be soon, m.
    ahead_m: Vector3<f64>,
    /// Cosine of the angle from the optical axis to the corner of the picture.
    cos_corner: f64,
}

impl Viewpoint {
    fn sees(&self, center_m: &Vector3<f64>, radius_m: f64) -> bool {
        let to_center = center_m - self.position_m;
        let distance_m = to_center.norm();
        if distance_m <= radius_m {
            return true;
        }
        let off_axis_rad = (to_center.dot(&self.forward) / distance_m).clamp(-1.0, 1.0).acos();
        off_axis_rad - (radius_m / distance_m).asin() <= self.cos_corner.acos()
    }
}

/// All groups that are in memory or can come back; when full, the remotest is forgotten.
#[derive(Debug)]
pub struct PageDirectory {
    /// Sorted by group.
    groups: Vec<PageGroup>,
    capacity: usize,
    pub(super) viewpoint: Viewpoint,
    /// Groups that were forgotten: their pages do not come back in this run.
    pub(super) n_forgotten: u64,
}

impl PageDirectory {
    /// Room for so many groups; `cos_corner` belongs to the camera.
    pub(super) fn new(capacity: usize, cos_corner: f64) -> Self {
        let viewpoint =
            Viewpoint { position_m: Vector3::zeros(), forward: Vector3::z(), ahead_m: Vector3::zeros(), cos_corner };
        Self { groups: Vec::with_capacity(capacity), capacity, viewpoint, n_forgotten: 0 }
    }

    /// Groups that it knows.
    pub(super) fn len(&self) -> usize {
        self.groups.len()
    }

    /// The vehicle is here now, and will be `lookahead_m` farther on soon.
    pub(super) fn look_from(&mut self, world_from_camera: &Rigid, lookahead_m: f64) {
        let before = self.viewpoint;
        let position_m = world_from_camera.translation.vector;
        let step = position_m - before.position_m;
        let travel = match step.try_normalize(MIN_STEP_M) {
            Some(travel) => travel,
            None => (before.ahead_m - before.position_m).try_normalize(MIN_STEP_M).unwrap_or_default(),
        };
        let forward = world_from_camera.rotation * Vector3::z();
        self.viewpoint = Viewpoint { position_m, forward, ahead_m: position_m + travel * lookahead_m, ..before };
    }

    /// What is known of a group.
    pub(super) fn get(&self, group: u32) -> Option<&PageGroup> {
        self.place_of(group).ok().map(|place| &self.groups[place])
    }

    /// What is known of a group, for changing.
    pub(super) fn get_mut(&mut self, group: u32) -> Option<&mut PageGroup> {
        self.place_of(group).ok().map(|place| &mut self.groups[place])
    }

    /// Every group, for changing.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut PageGroup> {
        self.groups.iter_mut()
    }

    /// Groups with rows in the backend's tables.
    pub(super) fn resident(&self) -> impl Iterator<Item = &PageGroup> {
        self.groups.iter().filter(|group| group.is_resident)
    }

    /// The oldest group with rows that passes.
    pub(super) fn first_resident(&self, passes: impl Fn(&PageGroup) -> bool) -> Option<u32> {
        self.resident().find(|group| passes(group)).map(|group| group.group)
    }

    /// Whether the anchors of a keyframe are in memory.
    pub(super) fn holds(&self, ordinal: u32) -> bool {
        self.get(ordinal / PAGE_KEYFRAMES).is_some_and(|group| group.is_resident)
    }

    /// What a keyframe shows that no other one did whose anchors are in memory, by its way from the nearest of them, m;
    /// `None` when there is no other.
    pub(super) fn nearest_view_m(
        &self,
        measure: &RouteMeasure,
        ordinal: u32,
        world_from_camera: &Rigid,
    ) -> Option<f64> {
        let others = self.resident().flat_map(PageGroup::keyframes).filter(|(other, _)| *other != ordinal);
        let steps_m = others.map(|(_, at)| {
            let world_from_other = Rigid::from_parts(Translation3::from(at.translation_m), at.rotation);
            measure.step_m(&world_from_other, world_from_camera)
        });
        steps_m.reduce(f64::min)
    }

    /// Notes where a keyframe is; false when there is no room for its group.
    pub(super) fn note(&mut self, ordinal: u32, placement: &KeyframePlacement) -> bool {
        let group = ordinal / PAGE_KEYFRAMES;
        let place = match self.place_of(group) {
            Ok(place) => place,
            Err(_) if self.groups.len() >= self.capacity && !self.forget_remotest() => return false,
            Err(_) => {
                let place = self.place_of(group).unwrap_or_else(|place| place);
                self.groups.insert(place, PageGroup::new(group));
                place
            }
        };
        self.groups[place].place(ordinal, placement);
        true
    }

    /// A group whose anchors are all gone needs no place.
    pub(super) fn remove(&mut self, group: u32) {
        if let Ok(place) = self.place_of(group) {
            self.groups.remove(place);
        }
    }

    /// Keeps only groups with something on disk.
    pub(super) fn retain_stored(&mut self) {
        self.groups.retain(|group| group.parts.stored != 0);
    }

    /// The best of the groups that pass, by a number that is the lower the better.
    pub(super) fn best(
        &self,
        passes: impl Fn(&PageGroup) -> bool,
        number: impl Fn(&PageGroup) -> f64,
    ) -> Option<(f64, u32)> {
        let numbered = self.groups.iter().filter(|group| passes(group)).map(|group| (number(group), group.group));
        numbered.min_by(|a, b| a.0.total_cmp(&b.0))
    }

    fn forget_remotest(&mut self) -> bool {
        let viewpoint = self.viewpoint;
        let remotest = self.best(|group| !group.is_resident, |group| -group.remoteness_m(&viewpoint));
        if let Some((_, group)) = remotest {
            self.remove(group);
            self.n_forgotten += 1;
        }
        remotest.is_some()
    }

    fn place_of(&self, group: u32) -> Result<usize, usize> {
        self.groups.binary_search_by_key(&group, |known| known.group)
    }
}

/// Where a keyframe is as it is mapped: its metres are the map's.
pub(super) fn placement_of(world_from_camera: &Rigid) -> KeyframePlacement {
    KeyframePlacement {
        rotation: world_from_camera.rotation,
        translation_m: world_from_camera.translation.vector,
        scale: 1.0,
    }
}

/// A point of a keyframe in the map.
pub(super) fn point_in_map(placement: &KeyframePlacement, point_in_keyframe_m: Vector3<f64>) -> [f64; 3] {
    (placement.rotation * Point3::from(placement.scale * point_in_keyframe_m) + placement.translation_m).coords.into()
}
