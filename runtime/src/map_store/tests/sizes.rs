//! What a store that is being written says about itself.

use super::*;

/// Bytes of all files of the map.
fn bytes_of_files(folder: &Path) -> u64 {
    all_files(folder).values().map(|content| content.len() as u64).sum()
}

#[test]
fn the_size_on_disk_is_known_at_any_time() {
    let scratch = scratch();
    let folder = scratch.path().join("map");
    let store = create(&folder);
    let mut before = 0;
    let mut check = |what: &str| {
        store.flush().expect("the disk takes it");
        assert_eq!(store.bytes_on_disk(), bytes_of_files(&folder), "{what}");
        assert!(store.bytes_on_disk() >= before, "{what}");
        before = store.bytes_on_disk();
    };
    check("nothing but the manifest");
    write_keyframe(&store, &keyframe(1)).expect("room");
    check("an image and its record");
    write_page(&store, 0).expect("room");
    check("a page");
    write_page(&store, 0).expect("room");
    check("the same page again, which replaces the older one");
    assert!(before > 0);
    assert_eq!(store.most_buffers(), [1, 1, 0]);
}
