//! Which views keep their picture on disk: those of streets that are new.

use kilogs_core::conventions::rotation_from_xyzw;
use kilogs_core::store::StoredKeyframe;
use nalgebra::Vector3;
use std::collections::HashMap;
use std::f64::consts::TAU;
use std::mem::size_of;

/// Edge of a place, m. Neighbours count, so a picture stands for what is 1 to 2 m around it: keyframes of a city drive are
/// that far apart, and the opposite lane is farther.
const PLACE_M: f64 = 1.0;
/// Headings that are told apart; neighbours count, so a picture stands for 22 to 45 degrees.
const HEADINGS: i64 = 16;
/// Keyframes after its first picture within which a place takes more: a slow passage has many keyframes in it, and what comes
/// after another street is another passage.
const PASSAGE_KEYFRAMES: u32 = 100;

/// A place, a heading, and whether the view judges the map or makes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Place {
    x: i32,
    z: i32,
    y: i16,
    heading: i8,
    is_held_out: bool,
}

impl Place {
    /// `None` for a pose that is not finite or farther than the integers reach.
    fn of(view: &StoredKeyframe) -> Option<Self> {
        let ahead = rotation_from_xyzw(view.rotation_xyzw) * Vector3::z();
        let [x, y, z] = view.translation_m.map(|coordinate_m| (coordinate_m / PLACE_M).floor());
        let turns = ahead.x.atan2(ahead.z) / TAU;
        let is_near = |cell: f64, most: f64| cell.abs() < most;
        (is_near(x, 1e9) && is_near(z, 1e9) && is_near(y, 3e4) && turns.is_finite()).then(|| Self {
            x: x as i32,
            z: z as i32,
            y: y as i16,
            heading: ((turns * HEADINGS as f64).floor() as i64).rem_euclid(HEADINGS) as i8,
            is_held_out: view.is_held_out,
        })
    }

    /// This place and those beside it.
    fn neighbourhood(self) -> impl Iterator<Item = Self> {
        (0..81_i32).map(move |i| {
            let [x, y, z, heading] = [i % 3 - 1, i / 3 % 3 - 1, i / 9 % 3 - 1, i / 27 - 1];
            Self {
                x: self.x + x,
                y: self.y + y as i16,
                z: self.z + z,
                heading: (i64::from(self.heading) + i64::from(heading)).rem_euclid(HEADINGS) as i8,
                ..self
            }
        })
    }
}

/// Picks the views whose pictures are stored, so that driving a street again does not fill the disk.
///
/// A place that got its first picture [`PASSAGE_KEYFRAMES`] ago takes no more. A view without a picture has its pose in the
/// keyframe log and trained the map while it was driven; it is neither refined with nor judged by. What does not fit any
/// more counts as new.
#[derive(Debug)]
pub struct PictureRule {
    /// The keyframe that brought a place its first picture.
    first: HashMap<Place, u32>,
    max_places: usize,
}

impl PictureRule {
    /// Takes the memory for `max_places` places.
    pub fn new(max_places: usize) -> Self {
        Self { first: HashMap::with_capacity(max_places), max_places }
    }

    /// Bytes that one place takes, with what a hash table leaves empty (at most half) and its byte of control.
    pub const fn bytes_per_place() -> usize {
        2 * (size_of::<(Place, u32)>() + 1)
    }

    /// Remembers a view that has its picture.
    pub fn remember(&mut self, view: &StoredKeyframe) {
        if let Some(place) = Place::of(view)
            && (self.first.len() < self.max_places || self.first.contains_key(&place))
        {
            self.first.entry(place).or_insert(view.keyframe_id);
        }
    }

    /// Whether the view shows a street that has no picture from there yet.
    pub fn admits(&self, view: &StoredKeyframe) -> bool {
        let is_old = |first: &u32| view.keyframe_id.saturating_sub(*first) >= PASSAGE_KEYFRAMES;
        let Some(place) = Place::of(view) else { return true };
        !place.neighbourhood().any(|near| self.first.get(&near).is_some_and(is_old))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kilogs_core::conventions::quaternion_xyzw;
    use nalgebra::UnitQuaternion;

    /// A view `z_m` along a street and `x_m` beside its middle.
    fn view(keyframe_id: u32, x_m: f64, z_m: f64, heading_deg: f64, is_held_out: bool) -> StoredKeyframe {
        let heading = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), heading_deg.to_radians());
        StoredKeyframe {
            keyframe_id,
            rotation_xyzw: quaternion_xyzw(&heading),
            translation_m: [x_m, 0.2, z_m],
            is_held_out,
            ..super::super::tests::keyframe(0)
        }
    }

    /// A rule that has seen a street of 150 m, a keyframe every 1.7 m, driven once.
    fn driven_once() -> PictureRule {
        let mut rule = PictureRule::new(1000);
        for id in 0..88 {
            let stored = view(id, 0.0, f64::from(id) * 1.7, 0.0, false);
            assert!(rule.admits(&stored), "keyframe {id} of the first passage");
            rule.remember(&stored);
        }
        rule
    }

    #[test]
    fn a_street_has_its_pictures_of_one_passage() {
        let rule = driven_once();
        let check = |x_m: f64, heading_deg: f64, is_held_out: bool, admitted: bool| {
            for id in 300..380 {
                let z_m = f64::from(id - 300) * 1.75 + 0.6;
                let view = view(id, x_m, z_m, heading_deg, is_held_out);
                assert_eq!(rule.admits(&view), admitted, "{x_m} m beside, {heading_deg} degrees, {z_m} m along");
            }
        };
        check(0.0, 0.0, false, false);
        check(0.9, 12.0, false, false);
        check(-0.9, -12.0, false, false);
        check(3.5, 0.0, false, true);
        check(0.0, 180.0, false, true);
        check(0.0, 90.0, false, true);
        check(0.0, 0.0, true, true);
    }

    #[test]
    fn a_circle_driven_for_ever_fills_nothing() {
        let mut rule = PictureRule::new(1000);
        let mut n_pictures = 0;
        for id in 0..10_000_u32 {
            let turn_deg = f64::from(id) * 7.3;
            let (sin, cos) = turn_deg.to_radians().sin_cos();
            let view = view(id, 8.0 * sin, 8.0 * cos, turn_deg + 90.0, false);
            if rule.admits(&view) {
                n_pictures += 1;
                rule.remember(&view);
            }
        }
        assert!((100..200).contains(&n_pictures), "{n_pictures} pictures of a circle of 50 m");
    }

    #[test]
    fn a_rule_that_is_full_takes_everything_and_no_memory() {
        let mut rule = PictureRule::new(10);
        let capacity = rule.first.capacity();
        for id in 0..1000 {
            rule.remember(&view(id, 0.0, f64::from(id) * 1.7, 0.0, false));
        }
        assert_eq!((rule.first.len(), rule.first.capacity()), (10, capacity));
        assert!(!rule.admits(&view(2000, 0.0, 0.0, 0.0, false)));
        assert!(rule.admits(&view(2000, 0.0, 1000.0, 0.0, false)));
        let lost = StoredKeyframe { translation_m: [f64::NAN; 3], ..view(1, 0.0, 0.0, 0.0, false) };
        rule.remember(&lost);
        assert!(rule.admits(&lost));
    }
}
