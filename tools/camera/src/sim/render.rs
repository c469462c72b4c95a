//! Casts one ray per pixel, and a few more where two surfaces meet.

use super::candidates::{Candidates, Frame};
use super::path::Drive;
use super::shapes::Hit;
use super::town::{self, CENTER_LINE_M, LANE_LEFT_M, LANE_RIGHT_M, Material, PARKING_M, Solid, Town};
use crate::noise::{detail, hash_unit, stripe};

/// Beyond this the town fades into haze, m.
pub const VIEW_DISTANCE_M: f64 = 180.0;
/// Depth written for the sky.
pub const SKY_DEPTH_M: f32 = f32::INFINITY;
/// Direction towards the sun, world axes (y down), unit.
const SUN: [f32; 3] = [0.48, -0.8, -0.36];
/// Color of ground without texture.
const BARE_GROUND: [f32; 3] = [0.34, 0.34, 0.35];
/// Color of the sky where it meets the ground, and of the haze.
const HORIZON: [f32; 3] = [0.86, 0.89, 0.93];
/// Color of the sky above, minus that of the horizon.
const ZENITH_STEP: [f32; 3] = [-0.42, -0.28, -0.08];
/// Sub-rays of a pixel where two surfaces meet.
const EDGE_SAMPLES: [(f32, f32); 4] = [(0.125, 0.375), (0.375, 0.875), (0.625, 0.125), (0.875, 0.625)];
/// Depth step between neighbours, relative, that makes an edge.
const EDGE_DEPTH_RATIO: f32 = 0.04;

/// Everything that a view needs.
pub struct Scene<'a> {
    /// The road.
    pub town: &'a Town,
    /// Where the camera is.
    pub frame: Frame,
    /// The solids that it can see.
    pub candidates: &'a Candidates,
}

/// One sample of the world: linear RGB in [0, 1], depth and an identity for edge finding.
#[derive(Clone, Copy)]
struct Sample {
    color: [f32; 3],
    depth_m: f32,
    identity: u32,
}

impl Scene<'_> {
    /// Renders packed RGB rows and the depth of every pixel's centre (infinite in the sky).
    pub fn render(&self, rgb: &mut [u8], depth_m: &mut [f32], identity: &mut [u32]) {
        let (width, height) = (self.frame.camera.width as usize, self.frame.camera.height as usize);
        for y in 0..height {
            for x in 0..width {
                let sample = self.sample(x as f32 + 0.5, y as f32 + 0.5);
                let i = y * width + x;
                depth_m[i] = sample.depth_m;
                identity[i] = sample.identity;
                write_rgb(&mut rgb[3 * i..3 * i + 3], sample.color);
            }
        }
        for y in 0..height {
            for x in 0..width {
                if is_edge(x, y, width, height, depth_m, identity) {
                    let mut color = [0.0; 3];
                    for (dx, dy) in EDGE_SAMPLES {
                        let sample = self.sample(x as f32 + dx, y as f32 + dy);
                        color = [0, 1, 2].map(|c| color[c] + sample.color[c] / EDGE_SAMPLES.len() as f32);
                    }
                    let i = y * width + x;
                    write_rgb(&mut rgb[3 * i..3 * i + 3], color);
                }
            }
        }
    }

    fn sample(&self, u_px: f32, v_px: f32) -> Sample {
        let ray = self.frame.ray(u_px, v_px);
        let ground_m = if ray.direction[1] > 0.0 { -ray.origin[1] / ray.direction[1] } else { f32::INFINITY };
        let limit_m = ground_m.min(VIEW_DISTANCE_M as f32);
        let solid = self.candidates.first_hit(&ray, (u_px, v_px), limit_m);
        let footprint = |depth_m: f32, slant: f32| depth_m / self.frame.camera.fx as f32 / slant.max(0.05);
        let (color, depth_m, identity) = match solid {
            Some((hit, solid)) => {
                let slant = cosine(&ray.direction, &hit.normal).abs();
                (shade(solid, &hit, footprint(hit.depth_m, slant)), hit.depth_m, solid.seed ^ face_of(&hit))
            }
            None if ground_m < VIEW_DISTANCE_M as f32 => {
                let slant = ray.direction[1] / norm(&ray.direction);
                let point = ray.at(ground_m);
                // A pixel of road is long and narrow; the mean of its sides keeps detail without flicker.
                (self.ground(point[0], point[2], footprint(ground_m, slant.sqrt())), ground_m, 1)
            }
            None => (sky(&ray.direction, !self.town.has_bare_stretch()), SKY_DEPTH_M, 0),
        };
        let haze = if depth_m.is_finite() { (depth_m / VIEW_DISTANCE_M as f32).powi(2).min(1.0) } else { 0.0 };
        Sample { color: [0, 1, 2].map(|c| color[c] + haze * (HORIZON[c] - color[c])), depth_m, identity }
    }

    /// Asphalt with markings, pavement, grass.
    fn ground(&self, x: f32, z: f32, footprint_m: f32) -> [f32; 3] {
        if self.town.is_bare_ground(z) {
            return BARE_GROUND;
        }
        let texture = detail(x, z, 7, footprint_m);
        let grass = [0.26 + 0.10 * texture, 0.36 + 0.13 * texture, 0.17 + 0.07 * texture];
        let Some(position) = self.town.road_position(x, z) else { return grass };
        let lateral = position.lateral_m;
        let width_m = footprint_m.max(1e-3);
        let asphalt_gray = 0.34 + 0.10 * texture + 0.03 * detail(0.2 * x, 0.2 * z, 8, 0.2 * footprint_m);
        let asphalt = [asphalt_gray, asphalt_gray, 1.03 * asphalt_gray];
        let dash = stripe(position.along_m.rem_euclid(9.0), 0.0, 3.5, width_m);
        let line = |middle: f32| stripe(lateral, middle - 0.07, middle + 0.07, width_m);
        let paint = (line(CENTER_LINE_M) * dash + line(LANE_RIGHT_M) + line(LANE_LEFT_M)).min(1.0);
        let painted = 0.80 + 0.10 * texture;
        let road = asphalt.map(|c| c + paint * (painted - c));
        let (left, right) = (LANE_LEFT_M - PARKING_M, LANE_RIGHT_M + PARKING_M);
        let on_road = stripe(lateral, left, right, width_m);
        let on_pavement = stripe(lateral, left - 2.2, right + 2.2, width_m) - on_road;
        let seam = 1.0 - stripe(position.along_m.rem_euclid(1.2), 0.04, 1.16, width_m);
        let slab = 0.52 + 0.09 * texture - 0.18 * seam;
        let beside = 1.0 - on_road - on_pavement;
        [0, 1, 2].map(|c| on_road * road[c] + on_pavement * slab + beside * grass[c])
    }
}

/// Adds cars that drive: one ahead of us, and oncoming ones in the other lane.
pub fn moving_cars(drive: &Drive, arc_m: f64, time_s: f64, seed: u32, out: &mut Vec<Solid>) {
    let mut push = |along_m: f64, lateral_m: f64, oncoming: bool, number: i32| {
        let at = drive.at(along_m);
        let variety = hash_unit(number, 3, seed);
        for (solid, material) in town::car(at, at.beside(lateral_m), oncoming, variety) {
            out.push(Solid {
                shape: town::Shape::Box(solid),
                material,
                seed: seed ^ (number as u32).wrapping_mul(0x9e37),
            });
        }
    };
    // The car ahead keeps its distance the way people do: not quite.
    push(arc_m + 24.0 + 5.0 * (0.35 * time_s).sin(), 0.05, false, 1);
    const ONCOMING_SPACING_M: f64 = 85.0;
    const ONCOMING_M_PER_S: f64 = 8.0;
    let first = ((arc_m + ONCOMING_M_PER_S * time_s) / ONCOMING_SPACING_M).floor();
    for k in 0..3 {
        let number = first + f64::from(k);
        let along_m = number * ONCOMING_SPACING_M - ONCOMING_M_PER_S * time_s;
        push(along_m, f64::from(CENTER_LINE_M) - 1.75, true, 100 + number as i32);
    }
}

fn shade(solid: &Solid, hit: &Hit, footprint_m: f32) -> [f32; 3] {
    let [along, up] = hit.surface_m;
    let texture = detail(along, up, solid.seed, footprint_m);
    let tint = |purpose: i32| hash_unit(purpose, 0, solid.seed);
    let albedo = match solid.material {
        Material::Facade if hit.is_top => [0.42 + 0.1 * texture, 0.25 + 0.07 * texture, 0.2 + 0.06 * texture],
        Material::Facade => facade(solid, along, up, texture, footprint_m),
        Material::CarBody => {
            let paint = [0.15 + 0.7 * tint(1), 0.15 + 0.6 * tint(2), 0.15 + 0.65 * tint(3)];
            paint.map(|c| c * (1.0 + 0.10 * texture) * if up < 0.3 { 0.35 } else { 1.0 })
        }
        Material::CarCabin => {
            let pillar = stripe(along.rem_euclid(1.1), 0.0, 0.12, footprint_m.max(1e-3));
            [0, 1, 2].map(|_| 0.13 + 0.05 * texture + 0.3 * pillar)
        }
        Material::Trunk => [0.30 + 0.12 * texture, 0.22 + 0.1 * texture, 0.15 + 0.07 * texture],
        Material::Crown => [0.20 + 0.13 * texture, 0.34 + 0.2 * texture, 0.13 + 0.1 * texture],
    };
    let sunlight = cosine(&hit.normal, &SUN).max(0.0);
    albedo.map(|c| c * (0.62 + 0.45 * sunlight))
}

/// Plaster or brick with rows of windows.
fn facade(solid: &Solid, along: f32, up: f32, texture: f32, footprint_m: f32) -> [f32; 3] {
    let tint = |purpose: i32| hash_unit(purpose, 1, solid.seed);
    let brightness = 0.45 + 0.4 * tint(1);
    let wall = [brightness, brightness * (0.8 + 0.2 * tint(2)), brightness * (0.65 + 0.35 * tint(3))];
    let wall = wall.map(|c| c * (1.0 + 0.28 * texture));
    let (bay_m, story_m) = (2.2 + 1.2 * tint(4), 2.8 + 0.4 * tint(5));
    let width_m = footprint_m.max(1e-3);
    let (in_bay, in_story) = (along.rem_euclid(bay_m), up.rem_euclid(story_m));
    let pane = |margin: f32| {
        stripe(in_bay, 0.55 - margin, 1.65 + margin, width_m) * stripe(in_story, 0.9 - margin, 2.2 + margin, width_m)
    };
    let (frame, glass) = (pane(0.12), pane(0.0));
    let number = ((along / bay_m).floor() as i32, (up / story_m).floor() as i32);
    let reflection = 0.10 + 0.28 * hash_unit(number.0, number.1, solid.seed) + 0.06 * texture;
    [0, 1, 2].map(|c| {
        let framed = wall[c] + frame * (0.85 - wall[c]);
        framed + glass * (reflection - framed)
    })
}

/// Blue above, white at the horizon, soft clouds.
fn sky(direction: &[f32; 3], has_clouds: bool) -> [f32; 3] {
    let up = (-direction[1] / norm(direction)).clamp(0.0, 1.0);
    let (over_x, over_z) = (direction[0] / (up + 0.08), direction[2] / (up + 0.08));
    let contrast = if has_clouds { 0.10 } else { 0.0 };
    let cloud = contrast * detail(0.5 * over_x, 0.5 * over_z, 77, 0.05 / (up + 0.05));
    let fade = up.sqrt();
    [0, 1, 2].map(|c| HORIZON[c] + ZENITH_STEP[c] * fade + cloud)
}

fn is_edge(x: usize, y: usize, width: usize, height: usize, depth_m: &[f32], identity: &[u32]) -> bool {
    let i = y * width + x;
    let mut edge = false;
    let mut compare = |j: usize| {
        let step = (depth_m[i] - depth_m[j]).abs() > EDGE_DEPTH_RATIO * depth_m[i].min(depth_m[j]);
        edge |= identity[i] != identity[j] || (identity[i] > 1 && step);
    };
    if x > 0 {
        compare(i - 1);
    }
    if x + 1 < width {
        compare(i + 1);
    }
    if y > 0 {
        compare(i - width);
    }
    if y + 1 < height {
        compare(i + width);
    }
    edge
}

fn face_of(hit: &Hit) -> u32 {
    // Faces of one box differ in their normal; sixteen directions tell them apart.
    let turn = hit.normal[0].atan2(hit.normal[2]) * (8.0 / std::f32::consts::PI);
    if hit.is_top { 0x100 } else { (turn.round() as i32 & 15) as u32 }
}

fn norm(v: &[f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

fn cosine(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / (norm(a) * norm(b))
}

fn write_rgb(pixel: &mut [u8], color: [f32; 3]) {
    for (byte, channel) in pixel.iter_mut().zip(color) {
        *byte = (channel.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    }
}
