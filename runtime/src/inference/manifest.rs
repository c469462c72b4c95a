//! Which networks there are, and what each file must be: `models/manifest.toml`.

use super::ModelError;
use serde::Deserialize;
use std::fmt;
use std::path::{Path, PathBuf};

const FILE: &str = "manifest.toml";

/// What a network is used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// Image to features at an eighth of its size (XFeat).
    XfeatFeatures,
    /// Two sets of features to matches (LighterGlue).
    XfeatMatcher,
    /// Pairs of coarse features to the offset between them (XFeat*).
    XfeatFine,
    /// Image to features of every pixel (DISK).
    DiskFeatures,
    /// Two sets of features to matches (LightGlue).
    DiskMatcher,
    /// Two images at once to a descriptor of every pixel of both (MASt3R and its kind).
    DensePair,
    /// Image to metric depth.
    MetricDepth,
    /// Two images to how different they look (LPIPS).
    Lpips,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::XfeatFeatures => "xfeat_features",
            Self::XfeatMatcher => "xfeat_matcher",
            Self::XfeatFine => "xfeat_fine",
            Self::DiskFeatures => "disk_features",
            Self::DiskMatcher => "disk_matcher",
            Self::DensePair => "dense_pair",
            Self::MetricDepth => "metric_depth",
            Self::Lpips => "lpips",
        })
    }
}

/// An input or an output of a network.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Port {
    /// Its name in the file.
    pub name: String,
    /// Its fixed size, batch first.
    pub shape: Vec<usize>,
}

/// What a depth network's numbers mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthUnit {
    /// Metres along the optical axis.
    Metres,
    /// One over metres.
    InverseMetres,
}

/// What only a depth network has to say.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthRow {
    /// What comes out.
    pub output: DepthUnit,
    /// Subtracted from each channel of the image, whose white is 1.
    pub mean: Vec<f32>,
    /// Each channel is divided by this afterwards.
    pub std: Vec<f32>,
    /// Focal length of the images that it was trained with, px of the network's input; depth is scaled by the camera's.
    /// Without it the network's numbers are taken as they are.
    pub focal_px: Option<f32>,
}

/// One network.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelRow {
    /// Its name in messages.
    pub name: String,
    /// File beside the manifest.
    pub file: String,
    /// What it is used for.
    pub role: Role,
    /// Checksum of the file, hexadecimal.
    pub sha256: String,
    /// What it takes.
    pub inputs: Vec<Port>,
    /// What it gives.
    pub outputs: Vec<Port>,
    /// Licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub origin: String,
    /// Command that makes the file.
    pub export: String,
    /// Only for [`Role::MetricDepth`].
    pub depth: Option<DepthRow>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Rows {
    model: Vec<ModelRow>,
}

/// The networks of a folder.
#[derive(Debug, Clone, PartialEq)]
pub struct Manifest {
    folder: PathBuf,
    rows: Vec<ModelRow>,
}

impl Manifest {
    /// The manifest of `folder`, or, where that is empty, of the first folder that has one: `models` beside the program,
    /// in the current folder, in the source tree.
    ///
    /// # Errors
    /// [`ModelError::NoFolder`] with all places, [`ModelError::Manifest`] with what is wrong.
    pub fn find(folder: &Path) -> Result<Self, ModelError> {
        let places = if folder.as_os_str().is_empty() { usual_places() } else { vec![folder.to_owned()] };
        match places.iter().find(|place| place.join(FILE).is_file()) {
            Some(place) => Self::read(place),
            None => Err(ModelError::NoFolder { places }),
        }
    }

    fn read(folder: &Path) -> Result<Self, ModelError> {
        let file = folder.join(FILE);
        let failed = |reason: String| ModelError::Manifest { file: file.clone(), reason };
        let text = std::fs::read_to_string(&file).map_err(|e| failed(e.to_string()))?;
        let rows: Rows = toml::from_str(&text).map_err(|e| failed(e.to_string().trim_end().to_owned()))?;
        for row in &rows.model {
            row.problem().map_or(Ok(()), |problem| Err(failed(format!("{}: {problem}", row.name))))?;
        }
        Ok(Self { folder: folder.to_owned(), rows: rows.model })
    }

    /// Every network.
    pub fn rows(&self) -> &[ModelRow] {
        &self.rows
    }

    /// The networks of a role.
    pub fn of_role(&self, role: Role) -> impl Iterator<Item = &ModelRow> {
        self.rows.iter().filter(move |row| row.role == role)
    }

    /// The first network of a role.
    ///
    /// # Errors
    /// [`ModelError::NoRow`].
    pub fn first(&self, role: Role) -> Result<&ModelRow, ModelError> {
        self.of_role(role).next().ok_or_else(|| ModelError::NoRow { manifest: self.folder.join(FILE), role })
    }

    /// Whether a network could be used.
    ///
    /// # Errors
    /// [`ModelError::NotBuilt`], [`ModelError::Missing`] or [`ModelError::WrongFile`].
    pub fn check(&self, row: &ModelRow) -> Result<(), ModelError> {
        self.bytes(row).map(drop)
    }

    /// The bytes of a network's file, if they are what the row says.
    ///
    /// # Errors
    /// [`ModelError::Missing`] or [`ModelError::WrongFile`].
    #[cfg(feature = "inference")]
    pub fn bytes(&self, row: &ModelRow) -> Result<Vec<u8>, ModelError> {
        use sha2::{Digest, Sha256};
        let (name, file, export) = (row.name.clone(), self.folder.join(&row.file), row.export.clone());
        let bytes = match std::fs::read(&file) {
            Ok(bytes) => bytes,
            Err(error) => return Err(ModelError::Missing { name, file, reason: error.to_string(), export }),
        };
        let found: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        if found != row.sha256 {
            return Err(ModelError::WrongFile { name, file, found, expected: row.sha256.clone(), export });
        }
        Ok(bytes)
    }

    #[cfg(not(feature = "inference"))]
    fn bytes(&self, _: &ModelRow) -> Result<Vec<u8>, ModelError> {
        Err(ModelError::NotBuilt)
    }
}

impl ModelRow {
    /// Width and height of the image that it takes, px.
    pub fn image_size(&self) -> (usize, usize) {
        match self.inputs.first().map(|port| port.shape.as_slice()) {
            Some(&[_, _, height, width]) => (width, height),
            _ => (0, 0),
        }
    }

    /// What the program cannot work with; the numbers of dimensions that it relies on later.
    fn problem(&self) -> Option<String> {
        let (inputs, outputs): (&[&[usize]], &[&[usize]]) = match self.role {
            Role::XfeatFeatures => (&[&[1, 3, 0, 0]], &[&[1, 64, 0, 0], &[1, 65, 0, 0], &[1, 1, 0, 0]]),
            Role::XfeatFine => (&[&[0, 128]], &[&[0, 64]]),
            Role::XfeatMatcher => (&[&[1, 0, 2], &[1, 0, 64], &[1, 0, 2], &[1, 0, 64]], &[&[1, 0, 0]]),
            Role::DiskFeatures => (&[&[1, 3, 0, 0]], &[&[1, 128, 0, 0], &[1, 1, 0, 0]]),
            Role::DiskMatcher => (&[&[1, 0, 2], &[1, 0, 128], &[1, 0, 2], &[1, 0, 128]], &[&[1, 0, 0]]),
            Role::DensePair => {
                (&[&[1, 0, 0, 0], &[1, 0, 0, 0]], &[&[1, 0, 0, 0], &[1, 1, 0, 0], &[1, 0, 0, 0], &[1, 1, 0, 0]])
            }
            Role::MetricDepth => (&[&[1, 0, 0, 0]], &[&[1, 1, 0, 0]]),
            Role::Lpips => (&[&[1, 3, 0, 0], &[1, 3, 0, 0]], &[&[1, 1, 1, 1]]),
        };
        let like = |ports: &[Port], wanted: &[&[usize]], what: &str| {
            let found: Vec<_> = ports.iter().map(|port| port.shape.as_slice()).collect();
            let fits = |found: &[usize], wanted: &[usize]| {
                found.len() == wanted.len() && found.iter().zip(wanted).all(|(&f, &w)| f > 0 && (w == 0 || f == w))
            };
            let is_like =
                found.len() == wanted.len() && found.iter().zip(wanted).all(|(found, wanted)| fits(found, wanted));
            (!is_like)
                .then(|| format!("{what} {found:?}, but role \"{}\" has {wanted:?} with any size for 0", self.role))
        };
        let pair = || match self.role {
            Role::DensePair => self.pair_problem(),
            Role::Lpips if self.inputs[0].shape != self.inputs[1].shape => {
                Some("both images need the same shape".to_owned())
            }
            _ => None,
        };
        like(&self.inputs, inputs, "inputs").or_else(|| like(&self.outputs, outputs, "outputs")).or_else(pair).or_else(
            || {
                let needs_depth = self.role == Role::MetricDepth;
                if needs_depth != self.depth.is_some() {
                    return Some("only and always a \"metric_depth\" has a depth = { .. }".to_owned());
                }
                let n_channels = self.inputs[0].shape.get(1).copied().unwrap_or(0);
                let depth = self.depth.as_ref()?;
                let is_wrong = ![1, 3].contains(&n_channels)
                    || [&depth.mean, &depth.std].iter().any(|list| list.len() != n_channels)
                    || depth.std.iter().any(|&s| s <= 0.0);
                is_wrong.then(|| {
                    "depth.mean and depth.std need a number, std above 0, for each of 1 or 3 channels".to_owned()
                })
            },
        )
    }
}

impl ModelRow {
    /// Both images of a pair are looked at in the same way.
    fn pair_problem(&self) -> Option<String> {
        let shape = |ports: &[Port], idx: usize| ports[idx].shape.clone();
        let is_alike = shape(&self.inputs, 0) == shape(&self.inputs, 1)
            && [0, 1].iter().all(|&idx| shape(&self.outputs, idx) == shape(&self.outputs, idx + 2))
            && shape(&self.outputs, 0)[2..] == shape(&self.outputs, 1)[2..];
        let has_channels = [1, 3].contains(&self.inputs[0].shape[1]);
        (!is_alike || !has_channels).then(|| {
            "both images need the same shape with 1 or 3 channels, and all descriptors and confidences the same maps"
                .to_owned()
        })
    }
}

/// Where what was trained is looked for: beside the program, in the current folder, in the source tree.
pub(crate) fn usual_places() -> Vec<PathBuf> {
    let beside = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join("models")));
    let source_tree = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    beside.into_iter().chain([PathBuf::from("models"), source_tree]).collect()
}
