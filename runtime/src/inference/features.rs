//! Keypoints and their descriptors, found by a network.

use super::ModelError;
use super::manifest::{Manifest, ModelRow, Role};
use super::network::Network;
use super::picture::{Fit, Picture, bilinear};
use tract_onnx::prelude::tvec;

/// Pixels of a side of XFeat's cells: its maps are an eighth of its input.
pub(super) const CELL_PX: usize = 8;
/// Channels of a cell's shares: its pixels, and "no keypoint here".
const CELL_CHANNELS: usize = CELL_PX * CELL_PX + 1;
/// A keypoint is the best pixel within this many in each direction: both authors' 5 x 5.
const NMS_RADIUS_PX: usize = 2;
/// Shares of a cell below this are noise, an even share is 1/65. Ours; the authors' 0.05 leaves fewer keypoints than the
/// matcher wants on plain roads.
const MIN_SHARE: f32 = 0.01;
/// DISK's own: what scores below is no keypoint.
const MIN_HEAT: f32 = 0.0;

/// Grey as it is: XFeat normalizes by itself, DISK wants white to be 1.
const PLAIN: (f32, f32) = (0.0, 1.0);

/// The features of an image.
#[derive(Debug, Clone)]
pub(super) struct Features {
    /// Where the image lies in the network's input.
    pub fit: Fit,
    /// Pixel indices in the network's input, best first; the pixel's centre is half a pixel on.
    pub places: Vec<[f32; 2]>,
    /// A unit vector for each place.
    pub descriptors: Vec<f32>,
}

impl Features {
    /// Where feature `idx` is in the camera's image, px.
    pub(super) fn camera_px(&self, idx: usize) -> [f32; 2] {
        self.fit.camera_px(self.places[idx].map(|c| c + 0.5))
    }
}

/// A network that finds features.
#[derive(Debug)]
pub(super) struct FeatureNetwork {
    network: Network,
    capacity: usize,
}

impl FeatureNetwork {
    /// The network of `role` for images of `image` px that gives at most `capacity` features.
    pub(super) fn load(
        manifest: &Manifest,
        role: Role,
        (image, max_width_px): ((usize, usize), usize),
        capacity: usize,
    ) -> Result<Self, ModelError> {
        let sizes = sizes_for(manifest, role, image, max_width_px);
        let row = match sizes.last() {
            Some(&row) => row,
            None => manifest.first(role)?,
        };
        Ok(Self { network: Network::load(manifest, row)?, capacity })
    }

    /// Features of an image, the best first.
    pub(super) fn find(&self, picture: &Picture) -> Result<Features, ModelError> {
        let row = self.network.row();
        let fit = Fit::new((picture.width, picture.height), row.image_size());
        let image = self.network.input(0, &fit.planes(picture, &[PLAIN; 3]))?;
        let outputs = self.network.run(tvec![image])?;
        let descriptors = self.network.numbers(&outputs[0])?;
        match row.role {
            Role::DiskFeatures => {
                let heat = self.network.numbers(&outputs[1])?;
                let maxima = local_maxima(heat, fit.input.0, fit.content, MIN_HEAT);
                Ok(Features::of_pixels(fit, best(maxima, self.capacity), descriptors))
            }
            _ => {
                let shares = self.network.numbers(&outputs[1])?;
                let reliability = Map { numbers: self.network.numbers(&outputs[2])?, fit };
                let mut maxima = local_maxima(&unfolded(shares, &fit), fit.input.0, fit.content, MIN_SHARE);
                maxima.iter_mut().for_each(|(place, score)| *score *= reliability.at(*place, 0));
                Ok(Features::of_cells(fit, best(maxima, self.capacity), descriptors))
            }
        }
    }
}

/// The networks of a role by size, up to the smallest that holds the image as it is; none that is wider than allowed.
pub(super) fn sizes_for(manifest: &Manifest, role: Role, image: (usize, usize), max_width_px: usize) -> Vec<&ModelRow> {
    let mut rows: Vec<_> = manifest.of_role(role).filter(|row| row.image_size().0 <= max_width_px).collect();
    rows.sort_by_key(|row| row.image_size());
    let holds = |row: &&ModelRow| row.image_size().0 >= image.0 && row.image_size().1 >= image.1;
    let n = rows.iter().position(holds).map_or(rows.len(), |first| first + 1);
    rows.truncate(n);
    rows
}

/// A keypoint's pixel in the network's input, and its score.
type Scored = ([f32; 2], f32);

impl Features {
    /// With descriptors between the centres of the cells.
    fn of_cells(fit: Fit, keypoints: Vec<Scored>, maps: &[f32]) -> Self {
        let map = Map { numbers: maps, fit };
        let n_channels = maps.len() / map.plane();
        let mut descriptors = Vec::with_capacity(keypoints.len() * n_channels);
        for &(place, _) in &keypoints {
            descriptors.extend((0..n_channels).map(|channel| map.at(place, channel)));
            normalize(&mut descriptors, n_channels);
        }
        Self { fit, places: keypoints.into_iter().map(|(place, _)| place).collect(), descriptors }
    }

    /// With descriptors of the pixels themselves.
    fn of_pixels(fit: Fit, keypoints: Vec<Scored>, planes: &[f32]) -> Self {
        let (width, height) = fit.input;
        let n_channels = planes.len() / (width * height);
        let mut descriptors = Vec::with_capacity(keypoints.len() * n_channels);
        for &([x, y], _) in &keypoints {
            let pixel = y as usize * width + x as usize;
            descriptors.extend((0..n_channels).map(|channel| planes[channel * width * height + pixel]));
        }
        Self { fit, places: keypoints.into_iter().map(|(place, _)| place).collect(), descriptors }
    }
}

/// Maps of an eighth of the network's input, one after the other.
struct Map<'a> {
    numbers: &'a [f32],
    fit: Fit,
}

impl Map<'_> {
    fn size(&self) -> (usize, usize) {
        (self.fit.input.0 / CELL_PX, self.fit.input.1 / CELL_PX)
    }

    fn plane(&self) -> usize {
        self.size().0 * self.size().1
    }

    /// Between the centres of cells, at the centre of a pixel of the network's input.
    fn at(&self, pixel: [f32; 2], channel: usize) -> f32 {
        let [u, v] = pixel.map(|c| (c + 0.5) / CELL_PX as f32);
        bilinear(&self.numbers[channel * self.plane()..], self.size(), u, v)
    }
}

/// XFeat's shares as a picture of the size of its input: channel 8 v + u of a cell is its pixel (u, v).
fn unfolded(shares: &[f32], fit: &Fit) -> Vec<f32> {
    let (width, height) = fit.input;
    let plane = shares.len() / CELL_CHANNELS;
    let mut heat = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let channel = CELL_PX * (y % CELL_PX) + x % CELL_PX;
            heat.push(shares[channel * plane + (y / CELL_PX) * (width / CELL_PX) + x / CELL_PX]);
        }
    }
    heat
}

/// Pixels of the content that are above `least` and above all neighbours; of equal ones, the first.
fn local_maxima(heat: &[f32], width: usize, content: (usize, usize), least: f32) -> Vec<Scored> {
    let mut found = Vec::new();
    for y in 0..content.1 {
        for x in 0..content.0 {
            let value = heat[y * width + x];
            if value <= least {
                continue;
            }
            let rows = y.saturating_sub(NMS_RADIUS_PX)..(y + NMS_RADIUS_PX + 1).min(content.1);
            let columns = x.saturating_sub(NMS_RADIUS_PX)..(x + NMS_RADIUS_PX + 1).min(content.0);
            let beats = |other: usize| heat[other] < value || (heat[other] == value && other >= y * width + x);
            if rows.flat_map(|v| columns.clone().map(move |u| v * width + u)).all(beats) {
                found.push(([x as f32, y as f32], value));
            }
        }
    }
    found
}

/// The `n` best, the best first; of equal ones, the first.
fn best(mut keypoints: Vec<Scored>, n: usize) -> Vec<Scored> {
    keypoints.sort_by(|a, b| b.1.total_cmp(&a.1));
    keypoints.truncate(n);
    keypoints
}

/// Makes the last `n` numbers a unit vector.
fn normalize(numbers: &mut [f32], n: usize) {
    let start = numbers.len() - n;
    let last = &mut numbers[start..];
    let length = last.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    last.iter_mut().for_each(|v| *v /= length);
}
