//! Why a trained network cannot be used. The classical path goes on; the text says what to do.

use super::manifest::Role;
use crate::budget::HumanBytes;
use std::path::PathBuf;

/// Why a trained network cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The program was built without the feature `inference`.
    #[error("this program was built without trained networks; build it with the feature \"inference\"")]
    NotBuilt,
    /// No folder of models was found.
    #[error(
        "looking for trained networks: no manifest.toml in {}; give the folder with --set inference.models=DIR",
        places.iter().map(|place| place.display().to_string()).collect::<Vec<_>>().join(", ")
    )]
    NoFolder {
        /// Where it was looked for.
        places: Vec<PathBuf>,
    },
    /// The manifest cannot be read, or says something that cannot be meant.
    #[error("reading {}: {reason}; compare it with models/README.md", file.display())]
    Manifest {
        /// The file.
        file: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The manifest has no network for this.
    #[error("looking for a network in {}: no row has the role \"{role}\"; add one, see models/README.md", manifest.display())]
    NoRow {
        /// The manifest.
        manifest: PathBuf,
        /// What was looked for.
        role: Role,
    },
    /// A file of the manifest is not there or not readable.
    #[error("reading the network {name} from {}: {reason}; make it with: {export}", file.display())]
    Missing {
        /// Name in the manifest.
        name: String,
        /// The file.
        file: PathBuf,
        /// Why.
        reason: String,
        /// Command that makes it.
        export: String,
    },
    /// A file is not the one that the manifest describes.
    #[error(
        "checking the network {name}: {} has the sha256 {found}, the manifest says {expected}; make it anew with: {export}, \
         or correct its row",
        file.display()
    )]
    WrongFile {
        /// Name in the manifest.
        name: String,
        /// The file.
        file: PathBuf,
        /// What the file's sum is.
        found: String,
        /// What it should be.
        expected: String,
        /// Command that makes it.
        export: String,
    },
    /// A network takes or gives something else than the manifest says.
    #[error("checking the network {name}: {what} is {found}, the manifest says {expected}; correct its row")]
    WrongShape {
        /// Name in the manifest.
        name: String,
        /// Which input or output.
        what: String,
        /// What it is.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A network compares pictures of another size.
    #[error(
        "comparing pictures by the network {name}: it takes {} x {} px, they have {} x {} px; export one for that size, \
         see models/README.md",
        takes.0, takes.1, pictures.0, pictures.1
    )]
    OtherSize {
        /// Name in the manifest.
        name: String,
        /// Width and height that it takes, px.
        takes: (usize, usize),
        /// Width and height of the pictures, px.
        pictures: (usize, usize),
    },
    /// The inference library does not understand the network, or failed to run it.
    #[error("{doing} the network {name}: {reason}; export it with fixed shapes and opset 17, see models/README.md")]
    Network {
        /// Name in the manifest.
        name: String,
        /// Loading or running.
        doing: &'static str,
        /// What the library says.
        reason: String,
    },
    /// A network takes more memory than the budget grants.
    #[error(
        "{what} takes {}, [inference.arena] of the budget grants {}; raise it, or set inference.max_width_px lower",
        HumanBytes(*needed),
        HumanBytes(*cap)
    )]
    OverCap {
        /// What was switched off.
        what: &'static str,
        /// The most bytes that were in use.
        needed: u64,
        /// The most that may be.
        cap: u64,
    },
    /// The inference library stopped in the middle.
    #[error("loading {what}: the library that runs networks broke down; export it with fixed shapes and opset 17")]
    Panicked {
        /// What was loaded.
        what: &'static str,
    },
    /// The system gave no thread.
    #[error("starting the inference thread: {0}; close other programs")]
    NoThread(std::io::Error),
}
