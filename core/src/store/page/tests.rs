//! Pages as bytes and back, damaged and whole.

use super::super::record::{STORE_VERSION, as_next_version, as_version, check_every_damage_is_noticed};
use super::*;
use crate::map::decoder::FEATURE_LEN;
use std::vec::Vec;

fn gaussian(seed: f32) -> GaussianParams {
    GaussianParams {
        offset: [seed, seed + 0.1, seed + 0.2],
        log_scale: [-seed; 3],
        quaternion_xyzw: [0.0, 0.0, seed, 1.0],
        opacity_logit: -1.7,
        color_logit: [seed * 2.0; 3],
    }
}

fn anchor(keyframe_id: u32, n_gaussians: u8) -> StoredAnchor {
    StoredAnchor {
        position_in_keyframe_m: [1.0, 2.0, 3.0 + keyframe_id as f32],
        keyframe_id,
        log_extent: [-2.0, -2.1, -2.2],
        level: 3,
        n_gaussians,
        feature_kind: 0,
    }
}

const LABEL: PageLabel = PageLabel {
    page_id: 4,
    chunk_id: 1,
    first_keyframe_id: 40,
    last_keyframe_id: 49,
    n_anchors: 0,
    n_gaussians: 0,
    gaussians_per_anchor: 2,
    revision: 0,
};

fn page(anchors: &[StoredAnchor]) -> Vec<u8> {
    let mut memory = std::vec![0xa5; 1000];
    let mut encoder = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
    for anchor in anchors {
        encoder.push(anchor, &[gaussian(0.25), gaussian(0.5)]).expect("room for all");
    }
    let (_, length) = encoder.finish().expect("sealed");
    memory.truncate(length);
    memory
}

#[test]
fn what_was_pushed_comes_back_in_order() {
    let pushed = [anchor(40, 2), anchor(49, 1), anchor(41, 0)];
    let bytes = page(&pushed);
    assert_eq!(bytes.len(), page_file_bytes(3, 3, false));
    assert_eq!(page_length(&bytes[..PAGE_HEADER_BYTES]).map(|(_, length)| length), Ok(bytes.len()));
    let (label, mut reader) = decode_page(&bytes).expect("undamaged");
    assert_eq!(label, PageLabel { n_anchors: 3, n_gaussians: 3, ..LABEL });
    assert_eq!(decode_page_label(&bytes[..PAGE_HEADER_BYTES]), Ok(label));
    let mut scratch = [gaussian(9.0); 2];
    assert_eq!(reader.next_anchor(&mut scratch), Some(pushed[0]));
    assert_eq!(scratch, [gaussian(0.25), gaussian(0.5)]);
    scratch[1] = gaussian(9.0);
    assert_eq!(reader.next_anchor(&mut scratch), Some(pushed[1]));
    assert_eq!(scratch, [gaussian(0.25), gaussian(9.0)]);
    assert_eq!(reader.next_anchor(&mut scratch), Some(pushed[2]));
    assert_eq!(reader.next_anchor(&mut scratch), None);
}

#[test]
fn features_come_back_where_there_are_any() {
    let mut feature = NO_FEATURE;
    (feature[0], feature[31]) = (-1.27, 0.5);
    let mut memory = std::vec![0xa5; page_file_bytes(3, 6, true)];
    let mut encoder = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
    let gaussians = [gaussian(0.25), gaussian(0.5)];
    for (id, feature) in [(40, &feature), (41, &NO_FEATURE), (42, &feature)] {
        encoder.push_with_feature(&anchor(id, 1), feature, &gaussians).expect("room for all");
    }
    let (_, length) = encoder.finish().expect("sealed");
    assert_eq!(length, page_file_bytes(1, 1, false) + 2 * (page_file_bytes(1, 1, true) - BODY_START));
    memory.truncate(length);
    let (_, mut reader) = decode_page(&memory).expect("undamaged");
    let mut scratch = [gaussian(9.0); 2];
    for (id, expected) in [(40, feature), (41, NO_FEATURE), (42, feature)] {
        let (found, got) = reader.next_with_feature(&mut scratch).expect("three anchors");
        assert_eq!((found.keyframe_id, scratch[0]), (id, gaussian(0.25)));
        assert!(got.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 0.0051), "{got:?}");
    }
    assert_eq!(reader.next_with_feature(&mut scratch), None);
    check_every_damage_is_noticed(&memory, |bytes| decode_page(bytes).map(|_| ()));
}

#[test]
fn a_page_of_the_first_version_is_read() {
    let bytes = page(&[anchor(40, 1)]);
    let mut old = as_version(1, &bytes[..LABEL_BYTES]);
    old.extend(as_version(1, &bytes[LABEL_BYTES..]));
    assert_eq!(decode_page(&old).map(|(label, _)| label), decode_page(&bytes).map(|(label, _)| label));
}

#[test]
fn every_flipped_bit_and_every_cut_is_noticed() {
    for anchors in [[].as_slice(), &[anchor(40, 2), anchor(41, 1)]] {
        check_every_damage_is_noticed(&page(anchors), |bytes| decode_page(bytes).map(|_| ()));
    }
}

#[test]
fn a_page_of_the_next_version_is_refused_as_such() {
    let verdict = decode_page(&as_next_version(&page(&[anchor(40, 1)]))).map(|_| ());
    assert_eq!(verdict, Err(RecordProblem::Version { found: STORE_VERSION + 1 }));
}

#[test]
fn content_that_contradicts_its_label_is_refused() {
    let verdict = |bytes: &[u8]| decode_page(bytes).map(|_| ());
    let foreign_keyframe = page(&[anchor(40, 1), anchor(50, 1)]);
    assert_eq!(verdict(&foreign_keyframe), Err(RecordProblem::Inconsistent { element: 1 }));
    let mut trailing = page(&[anchor(40, 1)]);
    trailing.push(0);
    assert_eq!(verdict(&trailing), Err(RecordProblem::Inconsistent { element: 0 }));
}

#[test]
fn a_full_page_refuses_and_stays_valid() {
    let capacity_bytes = page_file_bytes(1, 2, true) + 10;
    let mut memory = std::vec![0; capacity_bytes];
    let mut encoder = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
    assert_eq!(encoder.push(&anchor(40, 1), &[gaussian(1.0)]), Ok(()));
    let full = Err(PageFull { capacity_bytes: capacity_bytes as u32 });
    assert_eq!(encoder.push(&anchor(41, 0), &[]), full);
    assert_eq!(encoder.label().n_anchors, 1);
    let (memory, length) = encoder.finish().expect("sealed");
    assert_eq!(decode_page(&memory[..length]).map(|page| page.0.n_anchors), Ok(1));
    assert!(PageEncoder::new([0u8; BODY_START - 1], LABEL).is_err());
}

#[test]
fn a_full_page_can_be_written_again_when_its_anchors_have_all_they_can() {
    let mut memory = std::vec![0; page_file_bytes(3, 6, true) + 10];
    let gaussians = [gaussian(0.25), gaussian(0.5)];
    let mut encoder = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
    let n_anchors = (40..=49).take_while(|&id| encoder.push(&anchor(id, 1), &gaussians).is_ok()).count();
    assert_eq!(n_anchors, 3, "each may come to have two Gaussians and a feature");
    let mut again = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
    for id in (40..=49).take(n_anchors) {
        assert_eq!(again.push_with_feature(&anchor(id, 2), &[0.5; FEATURE_LEN], &gaussians), Ok(()), "{id}");
    }
    assert_eq!(again.finish().map(|(_, n_bytes)| n_bytes), Ok(page_file_bytes(3, 6, true)));
}

#[test]
fn an_anchor_with_more_gaussians_than_allowed_is_refused() {
    let mut encoder = PageEncoder::new([0u8; 900], LABEL).expect("room for a label");
    assert!(encoder.push(&anchor(40, 3), &[gaussian(1.0); 3]).is_err(), "above the label's capacity");
    assert!(encoder.push(&anchor(40, 2), &[gaussian(1.0)]).is_err(), "above the slice");
}
