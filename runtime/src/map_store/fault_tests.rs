//! Real processes that die or run out of disk while they write a map.

use super::tests::{create, keyframe, open, scratch, write_keyframe, write_page};
use super::*;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Tells the child process below where to write; unset in an ordinary test run.
const FOLDER_VARIABLE: &str = "KILOGS_TEST_ENDLESS_MAP";
const CHILD_TEST: &str = "map_store::fault_tests::endless_writer";
/// More than any of these tests lets it write.
const MAX_PAGES: u32 = 20_000;
const PATIENCE: Duration = Duration::from_secs(60);

/// Not a test of its own: what the tests below run as a child process. Writes pages until it is stopped.
#[test]
fn endless_writer() {
    let Some(folder) = std::env::var_os(FOLDER_VARIABLE) else { return };
    let store = create(Path::new(&folder));
    for page_id in 0..MAX_PAGES {
        let written = write_keyframe(&store, &keyframe(page_id * 2))
            .and_then(|()| write_keyframe(&store, &keyframe(page_id * 2 + 1)))
            .and_then(|()| write_page(&store, page_id));
        if written.is_err() {
            break;
        }
    }
    match store.finish() {
        Ok(summary) => println!("finished: {summary:?}"),
        Err(error) => println!("store error: {error}"),
    }
}

/// The child, started by a shell that runs `before` first.
fn start(folder: &Path, before: &str) -> Child {
    let program = std::env::current_exe().expect("the test binary");
    Command::new("sh")
        .arg("-c")
        .arg(format!("{before} exec \"$0\" --exact {CHILD_TEST} --nocapture"))
        .arg(program)
        .env(FOLDER_VARIABLE, folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("a shell")
}

fn wait_for(what: &str, is_true: impl Fn() -> bool) {
    let started = Instant::now();
    while !is_true() {
        assert!(started.elapsed() < PATIENCE, "{what} did not happen within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// Every page that is listed is whole and has its keyframes with their images.
fn check_whole(map: &MapStoreReader) {
    let mut buffer = Vec::new();
    for page in map.pages() {
        let (label, _) = map.read_page(page.page_id, &mut buffer).expect("listed pages are whole");
        assert_eq!((label.page_id, label.n_anchors), (page.page_id, 2));
        for id in page.first_keyframe_id..=page.last_keyframe_id {
            let keyframe = map.keyframe(id).expect("keyframes are written before their pages");
            assert!(map.read_image(keyframe).is_ok(), "images are written before their records");
        }
    }
}

#[test]
fn a_killed_process_leaves_every_page_it_completed() {
    for n_pages in [1, 7, 40] {
        let scratch = scratch();
        let folder = scratch.path().join("map");
        let mut child = start(&folder, "");
        let nth_page = folder.join(format!("pages/{:08}.kgs", n_pages - 1));
        wait_for("a page", || nth_page.exists());
        child.kill().expect("SIGKILL");
        let _ = child.wait();
        let map = open(&folder);
        assert!(map.pages().len() >= n_pages && map.manifest().counts.is_none());
        // At most the record that was being appended is torn.
        assert!(map.damages().len() <= 1, "{:?}", map.damages());
        check_whole(&map);
    }
}

#[test]
fn a_file_that_cannot_grow_ends_the_run_with_advice_and_a_readable_map() {
    let scratch = scratch();
    let folder = scratch.path().join("map");
    // Files of at most 4 KiB (the keyframe log ends in mid-record or not), and no signal instead of the error.
    let child = start(&folder, "trap '' 25; ulimit -f 8;");
    let output = child.wait_with_output().expect("the child ends by itself");
    let said = text(&output);
    assert!(said.contains("store error: writing the map: appending to"), "{said}");
    assert!(said.contains("keyframes.kgs") && said.contains("the disk is full: free space"), "{said}");
    let map = open(&folder);
    assert!(map.pages().len() > 2 && map.manifest().counts.is_none());
    check_whole(&map);
}

/// The shell could not mount, or `unshare` never came to start it; anything else is the program's own failure.
fn is_without_namespace(output: &Output) -> bool {
    const CANNOT_MOUNT: i32 = 77;
    output.status.code() == Some(CANNOT_MOUNT)
        || (!output.status.success() && String::from_utf8_lossy(&output.stderr).starts_with("unshare:"))
}

#[test]
fn a_file_system_that_fills_up_ends_the_run_with_advice_and_a_readable_map() {
    let scratch = scratch();
    let folder = scratch.path().join("map");
    // A small file system of its own, in a mount namespace that ends with the child; what was written is copied out.
    let copy = scratch.path().join("copy");
    let inside = format!(
        "mkdir -p '{0}' && mount -t tmpfs -o size=128k none '{0}' || exit 77; \"$0\" --exact {CHILD_TEST} --nocapture; \
         cp -r '{0}' '{1}'",
        folder.display(),
        copy.display()
    );
    let program = std::env::current_exe().expect("the test binary");
    let output = Command::new("unshare")
        .args(["--mount", "--map-root-user", "sh", "-c", &inside])
        .arg(program)
        .env(FOLDER_VARIABLE, folder.join("map"))
        .output();
    let output = match output {
        Ok(output) if is_without_namespace(&output) => {
            println!("left out: this machine does not let a test mount a small file system ({})", text(&output).trim());
            return;
        }
        Ok(output) => output,
        Err(error) => {
            println!("left out: unshare cannot be started ({error})");
            return;
        }
    };
    assert!(output.status.success(), "{}: {}", output.status, text(&output));
    let said = text(&output);
    assert!(said.contains("store error: writing the map") && said.contains("the disk is full: free space"), "{said}");
    let map = open(&copy.join("map"));
    assert!(map.pages().len() > 2 && map.manifest().counts.is_none());
    assert!(map.damages().len() <= 1, "{:?}", map.damages());
    check_whole(&map);
}
