//! A chunk's own part of the map: its decoder's parameters and the background that colors its sky.

use super::record::{self, PREFIX_BYTES, RecordKind, RecordProblem};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// What a chunk covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct ChunkLabel {
    /// Ordinal of the chunk in the map; names its file.
    pub chunk_id: u32,
    /// First keyframe of the chunk.
    pub first_keyframe_id: u32,
    /// Last keyframe of the chunk.
    pub last_keyframe_id: u32,
    /// How many times this chunk was written before (0 the first time).
    pub revision: u32,
}

/// Parameters of the chunk's decoder, opaque to the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecoderParams<'a> {
    /// What the bytes are; 0 stands for "explicit Gaussians, no decoder", with no bytes.
    pub kind: u32,
    /// The parameters, as that kind defines them.
    pub bytes: &'a [u8],
}

impl DecoderParams<'_> {
    /// Gaussians are stored as they are: nothing to decode.
    pub const EXPLICIT: Self = Self { kind: 0, bytes: &[] };
    /// Kind of a decoder in the layout of [`crate::map::decoder`], as `f32`.
    pub const RESIDUAL_KIND: u32 = 1;
}

impl<'a> DecoderParams<'a> {
    /// A decoder in the layout of [`crate::map::decoder`].
    pub fn residual(weights: &'a [f32]) -> Self {
        Self { kind: Self::RESIDUAL_KIND, bytes: weights.as_bytes() }
    }

    /// Whether it adds something to what anchors store.
    pub fn is_residual(&self) -> bool {
        self.kind == Self::RESIDUAL_KIND
    }

    /// Copies a decoder of this length; false, and nothing written, when it is another kind, has another length or a
    /// number that is not finite.
    pub fn read_residual(&self, weights: &mut [f32]) -> bool {
        let (numbers, rest) = self.bytes.as_chunks::<4>();
        let values = || numbers.iter().map(|bytes| f32::from_le_bytes(*bytes));
        let fits = self.is_residual() && rest.is_empty() && numbers.len() == weights.len();
        if !fits || !values().all(f32::is_finite) {
            return false;
        }
        weights.iter_mut().zip(values()).for_each(|(weight, value)| *weight = value);
        true
    }
}

/// Colors of what is infinitely far, by direction: rows of RGB texels in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkBackground<'a> {
    /// Texels per row; 0 for a chunk without a background.
    pub width: u32,
    /// RGB, whole rows of them; the mapping from direction to texel is the backend's.
    pub texels: &'a [[f32; 3]],
}

impl ChunkBackground<'_> {
    /// A chunk without a background.
    pub const NONE: Self = Self { width: 0, texels: &[] };
}

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct ChunkHeader {
    chunk_id: u32,
    first_keyframe_id: u32,
    last_keyframe_id: u32,
    revision: u32,
    decoder_kind: u32,
    decoder_bytes: u32,
    background_width: u32,
    background_texels: u32,
}

const HEADER_END: usize = PREFIX_BYTES + size_of::<ChunkHeader>();

/// Size of a chunk file, for buffers and budgets.
pub const fn chunk_record_bytes(decoder_bytes: usize, background_texels: usize) -> usize {
    HEADER_END + decoder_bytes + background_texels * size_of::<[f32; 3]>()
}

/// Writes a chunk to the front of `memory`; returns its length, or `None` when it does not fit
/// (see [`chunk_record_bytes`]) or the background is not whole rows.
pub fn encode_chunk(
    label: &ChunkLabel,
    decoder: DecoderParams<'_>,
    background: ChunkBackground<'_>,
    memory: &mut [u8],
) -> Option<usize> {
    let header = ChunkHeader {
        chunk_id: label.chunk_id,
        first_keyframe_id: label.first_keyframe_id,
        last_keyframe_id: label.last_keyframe_id,
        revision: label.revision,
        decoder_kind: decoder.kind,
        decoder_bytes: u32::try_from(decoder.bytes.len()).ok()?,
        background_width: background.width,
        background_texels: u32::try_from(background.texels.len()).ok()?,
    };
    if !is_whole_rows(&header) {
        return None;
    }
    let decoder_end = HEADER_END.checked_add(decoder.bytes.len())?;
    let end = decoder_end.checked_add(size_of_val(background.texels))?;
    memory.get_mut(decoder_end..end)?.copy_from_slice(background.texels.as_bytes());
    memory.get_mut(HEADER_END..decoder_end)?.copy_from_slice(decoder.bytes);
    memory.get_mut(PREFIX_BYTES..HEADER_END)?.copy_from_slice(header.as_bytes());
    record::seal(RecordKind::Chunk, memory, end - PREFIX_BYTES)
}

fn is_whole_rows(header: &ChunkHeader) -> bool {
    match header.background_width {
        0 => header.background_texels == 0,
        row => header.background_texels.is_multiple_of(row),
    }
}

/// A verified chunk file.
#[derive(Clone, Copy, Debug)]
pub struct ChunkView<'a> {
    /// What the chunk covers.
    pub label: ChunkLabel,
    /// Its decoder.
    pub decoder: DecoderParams<'a>,
    /// Texels per row of its background; 0 when it has none.
    pub background_width: u32,
    background: &'a [u8],
}

impl ChunkView<'_> {
    /// Texels of the background.
    pub fn background_texels(&self) -> usize {
        self.background.len() / size_of::<[f32; 3]>()
    }

    /// Copies the background to the front of `texels`, as much as fits; returns how many texels that were.
    pub fn read_background(&self, texels: &mut [[f32; 3]]) -> usize {
        let n_texels = texels.len().min(self.background_texels());
        for (texel, bytes) in texels.iter_mut().zip(self.background.as_chunks::<12>().0) {
            if let Ok(rgb) = FromBytes::read_from_bytes(bytes) {
                *texel = rgb;
            }
        }
        n_texels
    }
}

/// Verifies a whole chunk file.
///
/// # Errors
/// [`RecordProblem`] when it is damaged; nothing of the chunk may be used.
pub fn decode_chunk(bytes: &[u8]) -> Result<ChunkView<'_>, RecordProblem> {
    const WRONG: RecordProblem = RecordProblem::Inconsistent { element: 0 };
    let body = record::open(RecordKind::Chunk, bytes)?;
    let (header, rest) = ChunkHeader::read_from_prefix(body).map_err(|_| WRONG)?;
    let (decoder, background) = rest.split_at_checked(header.decoder_bytes as usize).ok_or(WRONG)?;
    let counted = Some(background.len()) == (header.background_texels as usize).checked_mul(size_of::<[f32; 3]>());
    if !counted || !is_whole_rows(&header) || bytes.len() != PREFIX_BYTES + body.len() {
        return Err(WRONG);
    }
    Ok(ChunkView {
        label: ChunkLabel {
            chunk_id: header.chunk_id,
            first_keyframe_id: header.first_keyframe_id,
            last_keyframe_id: header.last_keyframe_id,
            revision: header.revision,
        },
        decoder: DecoderParams { kind: header.decoder_kind, bytes: decoder },
        background_width: header.background_width,
        background,
    })
}

#[cfg(test)]
mod tests {
    use super::super::record::check_every_damage_is_noticed;
    use super::*;

    const LABEL: ChunkLabel = ChunkLabel { chunk_id: 2, first_keyframe_id: 200, last_keyframe_id: 299, revision: 1 };
    const RGB: [[f32; 3]; 4] = [[0.0, 0.1, 0.2], [0.3, 0.4, 0.5], [0.6, 0.7, 0.8], [0.9, 1.0, 0.25]];

    #[test]
    fn decoder_and_background_come_back() {
        // An odd number of decoder bytes leaves the background unaligned.
        for (decoder, background) in [
            (DecoderParams { kind: 7, bytes: &[1, 2, 3] }, ChunkBackground { width: 2, texels: &RGB }),
            (DecoderParams::EXPLICIT, ChunkBackground::NONE),
        ] {
            let mut memory = [0xa5; 200];
            let length = encode_chunk(&LABEL, decoder, background, &mut memory).expect("it fits");
            assert_eq!(length, chunk_record_bytes(decoder.bytes.len(), background.texels.len()));
            let view = decode_chunk(&memory[..length]).expect("undamaged");
            assert_eq!((view.label, view.decoder, view.background_width), (LABEL, decoder, background.width));
            let mut texels = [[-1.0; 3]; 5];
            assert_eq!(view.read_background(&mut texels), background.texels.len());
            assert_eq!(&texels[..background.texels.len()], background.texels);
            assert_eq!(texels[4], [-1.0; 3]);
            check_every_damage_is_noticed(&memory[..length], |bytes| decode_chunk(bytes).map(|_| ()));
        }
    }

    #[test]
    fn a_residual_decoder_comes_back_or_is_refused() {
        let weights = [0.5, -1.25, 3e-7];
        let decoder = DecoderParams::residual(&weights);
        let mut memory = [0; 200];
        let length = encode_chunk(&LABEL, decoder, ChunkBackground::NONE, &mut memory).expect("it fits");
        let view = decode_chunk(&memory[..length]).expect("undamaged");
        let mut read = [9.0; 3];
        assert!(view.decoder.read_residual(&mut read));
        assert_eq!(read, weights);
        assert!(!view.decoder.read_residual(&mut read[..2]), "another length");
        assert!(!DecoderParams::residual(&[0.0, f32::NAN, 0.0]).read_residual(&mut read), "no number");
        assert!(!DecoderParams::EXPLICIT.read_residual(&mut []), "another kind");
        assert_eq!(read, weights);
    }

    #[test]
    fn what_does_not_fit_or_is_no_table_is_refused() {
        let table = ChunkBackground { width: 2, texels: &RGB };
        let needed = chunk_record_bytes(0, RGB.len());
        let mut memory = [0; 200];
        assert!(encode_chunk(&LABEL, DecoderParams::EXPLICIT, table, &mut memory[..needed - 1]).is_none());
        assert!(encode_chunk(&LABEL, DecoderParams::EXPLICIT, table, &mut memory[..needed]).is_some());
        let ragged = ChunkBackground { width: 2, texels: &RGB[..3] };
        assert!(encode_chunk(&LABEL, DecoderParams::EXPLICIT, ragged, &mut memory).is_none());
    }
}
