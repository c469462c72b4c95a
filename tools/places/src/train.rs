//! Learns words from the features of recordings.

use crate::error::PlacesError;
use crate::frames::{Extractor, Frames};
use crate::tree::{TreeShape, grow};
use kilogs_camera::source::PlaybackRange;
use kilogs_core::features::Descriptor;
use kilogs_core::places::{Below, RARITY_STEPS, Vocabulary, VocabularyNode, encode_vocabulary, vocabulary_bytes};
use std::path::PathBuf;

/// Options of `train`.
#[derive(Debug, clap::Args)]
pub(crate) struct TrainArgs {
    /// Folders of recordings.
    #[arg(required = true)]
    folders: Vec<PathBuf>,
    /// Simulated streets that are looked at too.
    #[arg(long, default_value_t = 0)]
    streets: u64,
    /// Look at every n-th image of a folder.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    every: u64,
    /// Features of an image.
    #[arg(long, default_value_t = 1024)]
    features: usize,
    /// Children of a node.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(2..256))]
    branching: u16,
    /// Levels of the tree.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..9))]
    depth: u16,
    /// Seed of the clustering.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The file to write.
    #[arg(long)]
    out: PathBuf,
}

/// Trains, writes, and says what came out.
pub(crate) fn run(args: &TrainArgs) -> Result<(), PlacesError> {
    let mut images: Vec<Vec<Descriptor>> = Vec::new();
    for folder in &args.folders {
        let before = images.len();
        look_at(Frames::of_folder(folder, &PlaybackRange::ALL)?, args, &mut images)?;
        println!("{}: {} images", folder.display(), images.len() - before);
    }
    for street in 0..args.streets {
        // Seeds that no test drives through.
        look_at(Frames::of_street(1000 + street)?, args, &mut images)?;
    }
    let shape = TreeShape { branching: args.branching.into(), depth: args.depth.into(), rounds: 12, seed: args.seed };
    let descriptors: Vec<_> = images.iter().flatten().copied().collect();
    let n_words = shape.branching.pow(args.depth.into());
    if descriptors.len() < n_words {
        return Err(PlacesError::TooFewFeatures { found: descriptors.len(), needed: n_words });
    }
    println!("{} descriptors of {} images", descriptors.len(), images.len());
    let mut nodes = grow(descriptors, &shape);
    let bytes = encoded(&nodes);
    weigh(&mut nodes, &open(&bytes, args)?, &images);
    let bytes = encoded(&nodes);
    let n_words = open(&bytes, args)?.n_words();
    std::fs::write(&args.out, &bytes).map_err(|source| PlacesError::File {
        what: "writing",
        path: args.out.clone(),
        source,
    })?;
    println!("{}: {n_words} words, {} nodes, {} bytes", args.out.display(), nodes.len(), bytes.len());
    Ok(())
}

fn open<'b>(bytes: &'b [u8], args: &TrainArgs) -> Result<Vocabulary<'b>, PlacesError> {
    Vocabulary::open(bytes).map_err(|problem| PlacesError::Vocabulary { path: args.out.clone(), problem })
}

fn look_at(mut frames: Frames, args: &TrainArgs, images: &mut Vec<Vec<Descriptor>>) -> Result<(), PlacesError> {
    let mut extractor = Extractor::new(&frames.format(), args.features);
    let mut n = 0;
    while let Some((image, _)) = frames.next()? {
        if n % args.every == 0 {
            images.push(extractor.features(image)?.iter().map(|feature| feature.descriptor).collect());
        }
        n += 1;
    }
    Ok(())
}

fn encoded(nodes: &[VocabularyNode]) -> Vec<u8> {
    let mut bytes = vec![0; vocabulary_bytes(nodes.len())];
    let written = encode_vocabulary(nodes, &mut bytes);
    debug_assert_eq!(written, Some(()));
    bytes
}

/// Sets how rare each word is in the images.
fn weigh(nodes: &mut [VocabularyNode], vocabulary: &Vocabulary<'_>, images: &[Vec<Descriptor>]) {
    let mut n_with = vec![0_u32; vocabulary.n_words()];
    for image in images {
        let mut words: Vec<_> = image.iter().map(|descriptor| vocabulary.word_of(descriptor).0).collect();
        words.sort_unstable();
        words.dedup();
        words.iter().for_each(|&word| n_with[usize::from(word)] += 1);
    }
    for node in nodes {
        if let Below::Word { word, rarity } = &mut node.below {
            let with = f64::from(n_with[usize::from(*word)].max(1));
            *rarity = ((images.len() as f64 / with).ln() * f64::from(RARITY_STEPS)).round() as u16;
        }
    }
}
