use super::*;
use crate::output::{Picture, Stage, StageTimes, write_render};
use kilogs_eval::ImageQuality;

/// A run folder with what the page reads: a bend, odometry beside it, two pictures.
fn page_of(report: &Report, n_frames: u64, n_pictures: u64) -> String {
    let dir = tempfile::tempdir().expect("temporary folder");
    let pose = |k: u64, offset: f64| {
        let turn = k as f64 * 0.01;
        format!("{} {} 0 {} 0 0 0 1\n", k, 80.0 * (1.0 - turn.cos()) + offset, 80.0 * turn.sin())
    };
    for (name, offset) in [("trajectory_tum.txt", 0.0), ("odometry_tum.txt", 1.0)] {
        let text: String = (0..n_frames).map(|k| pose(k, offset * k as f64 * 0.02)).collect();
        std::fs::write(dir.path().join(name), text).expect("trajectory");
    }
    let mut chart = DriveChart::default();
    for k in 0..n_frames {
        let mut times = StageTimes::default();
        times.add(Stage::Tracking, 20.0 + (k % 7) as f32);
        if k % 4 == 0 {
            times.add(Stage::Mapping, 150.0);
            times.add(Stage::Insertion, 12.0);
        }
        chart.push(&times, 300_000_000 + k * 1000);
    }
    let pixels = vec![100; 64 * 32];
    let picture = Picture { bytes: &pixels, width: 64, height: 32, channels: 1 };
    let quality = ImageQuality { psnr_db: 18.5, ssim: 0.61 };
    let pictures: Vec<_> = (0..n_pictures)
        .map(|k| write_render(dir.path(), k, k * 100_000_000, quality, picture, picture).expect("picture"))
        .collect();
    let read = || std::fs::read_to_string(dir.path().join("report.html")).expect("report.html");
    write_html(dir.path(), report, &chart, &pictures).expect("a page");
    let page = read();
    rewrite_html(dir.path(), report, &pictures).expect("a page");
    assert!(page == read(), "the page written anew is another one");
    rewrite_html(dir.path(), &Report { command: "another".to_owned(), ..Report::default() }, &[]).expect("a page");
    let (other, charts) = (read(), page.matches("Time per frame").count());
    assert!(other.contains("<code>another</code>") && !other.contains("<img"));
    assert_eq!(other.matches("Time per frame").count(), charts);
    page
}

#[test]
fn the_page_stands_alone_and_shows_everything() {
    let mut report = Report { command: "kilogs replay <data> & \"more\"".to_owned(), ..Report::default() };
    report.tracking.loops = 1;
    report.memory.budget_host_bytes = 512 << 20;
    let page = page_of(&report, 300, 30);
    for needed in
        ["&lt;data&gt; &amp; &quot;more&quot;", "live odometry", "cap of the budget", "psnr_worst_100m_db", "18.50 dB"]
    {
        assert!(page.contains(needed), "{needed}");
    }
    for outside in ["<script", "http:", "https:", "url(", "<link"] {
        let without_namespace = page.replace("http://www.w3.org/2000/svg", "");
        assert!(!without_namespace.contains(outside), "{outside}");
    }
    assert_eq!(page.matches("<svg").count(), 3);
    assert_eq!(page.matches("data:image/jpeg;base64,").count(), 2 * MAX_PICTURES);
    assert_eq!(page.matches("<section").count(), page.matches("</section>").count());
}

#[test]
fn a_run_without_poses_maps_or_loops_has_a_page_too() {
    let page = page_of(&Report::default(), 0, 0);
    assert!(page.contains("No frame has a pose.") && !page.contains("<svg") && !page.contains("<img"));
    let page = page_of(&Report::default(), 1, 0);
    assert!(!page.contains("live odometry") && page.matches("<svg").count() == 3);
}

#[test]
fn marks_of_the_charts_are_known_to_the_style() {
    let page = page_of(&Report::default(), 40, 0);
    let (_, charts) = page.split_once("</style>").expect("a style");
    for attribute in ["fill=\"#", "stroke=\"#"] {
        for mark in charts.split(attribute).skip(1).map(|rest| &rest[..6]) {
            let known = ["FFFFFF", "000000"].contains(&mark) || STYLE.contains(&format!("#{mark}\"]"));
            assert!(known, "{attribute}{mark} has no color in style.css");
        }
    }
}
