//! Disks that are full, folders that cannot be written, and memory that is not taken.

use super::*;

#[test]
fn a_full_disk_stops_writing_with_advice_and_keeps_what_was_complete() {
    let scratch = scratch();
    let store = create(scratch.path());
    write_keyframe(&store, &keyframe(0)).expect("taken");
    write_keyframe(&store, &keyframe(1)).expect("taken");
    write_page(&store, 0).expect("taken");
    store.flush().expect("written");
    // Every byte written to this device meets a full disk.
    std::os::unix::fs::symlink("/dev/full", scratch.path().join("pages/00000001.tmp")).expect("linked");
    write_page(&store, 1).expect("taken");
    assert_eq!(store.flush(), Err(WriteRefusal::Stopped));
    assert_eq!(store.begin_page(page_label(2)).map(|_| ()), Err(WriteRefusal::Stopped));
    assert_eq!(write_keyframe(&store, &keyframe(2)), Err(WriteRefusal::Stopped));
    let error = store.finish().expect_err("the disk is full").to_string();
    assert!(error.contains("00000001.tmp") && error.contains("the disk is full: free space"), "{error}");

    let map = open(scratch.path());
    assert_eq!((map.pages().len(), map.keyframes().len(), map.damages().len()), (1, 2, 0));
}

#[test]
fn a_folder_that_cannot_be_written_is_an_error_with_advice() {
    let scratch = scratch();
    let file = scratch.path().join("file");
    std::fs::write(&file, b"").expect("written");
    for (folder, text) in [(Path::new("/proc/map"), "creating /proc/map"), (&file.join("map"), "file/map")] {
        let error = MapStoreWriter::create(folder, &manifest(PixelFormat::Rgb8), &settings(WhenBusy::Wait));
        let error = error.expect_err("refused").to_string();
        assert!(error.contains(text), "{error}");
    }
}

#[test]
fn handing_over_allocates_nothing() {
    let scratch = scratch();
    let store = create(scratch.path());
    let pixels = vec![7; (SIZE.0 * SIZE.1 * 3) as usize];
    let image = StoreImage { pixels: &pixels, stride_bytes: SIZE.0 as usize * 3 };
    let sealed = crate::seal::enter();
    // More than there are buffers: the writer waits for the disk in between.
    for page_id in 0..8 {
        let taken = store.write_keyframe(&keyframe(page_id * 2), image);
        let taken = taken.and_then(|()| store.place_keyframe(&keyframe(page_id * 2 + 1)));
        let taken = taken.and_then(|()| write_page(&store, page_id));
        let label = ChunkLabel { chunk_id: page_id, ..ChunkLabel::default() };
        let background = ChunkBackground { width: 2, texels: &[[0.25; 3]; 4] };
        let taken = taken.and_then(|()| store.write_chunk(&label, DecoderParams::EXPLICIT, background));
        assert_eq!(taken, Ok(()));
    }
    assert_eq!(sealed.violations(), (0, 0));
    drop(sealed);
    assert_eq!(store.finish().map(|summary| summary.counts.pages).ok(), Some(8));
}

#[test]
fn a_page_may_span_keyframes_that_never_mapped() {
    let scratch = scratch();
    let store = create(scratch.path());
    // Of the page's two keyframes, one was held out and another frame was stored to judge by instead.
    assert_eq!(write_keyframe(&store, &keyframe(0)), Ok(()));
    let mut page = store.begin_page(page_label(0)).expect("a free buffer");
    page.push(&anchor(0), &GAUSSIANS).expect("room for an anchor");
    assert_eq!(store.commit_page(page), Ok(()));
    store.finish().expect("written");
    let map = open(scratch.path());
    assert_eq!((map.pages().len(), map.damages()), (1, [].as_slice()), "not a damage");
}
