//! Defaults, files and single values, and what is refused of them.

use super::schema::{Kind, Setting};
use super::table::SETTINGS;
use super::*;
use kilogs_core::tracking::{DynamicFilter, PoseModels};

/// Settings from a file's text (when there is one) and `--set` values.
fn settings(file: Option<&str>, set: &[&str]) -> Result<Settings, ConfigError> {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("my.toml");
    if let Some(text) = file {
        std::fs::write(&path, text).expect("a file");
    }
    load(&ConfigArgs { config: file.map(|_| path), set: set.iter().map(|&text| text.to_owned()).collect() })
}

#[test]
fn the_defaults_are_valid_and_the_command_line_beats_the_file() {
    let check = |file, set: &[&str], expected: (DynamicFilter, f64)| {
        let found = settings(file, set).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(
            (found.tracking.tracker.dynamic_filter, found.mapping.mapper.resolution),
            expected,
            "{file:?} {set:?}"
        );
    };
    let file = "[tracking]\ndynamic_filter = \"off\"\n[mapping]\nresolution = 1\n";
    check(None, &[], (DynamicFilter::Region, 0.5));
    check(Some(file), &[], (DynamicFilter::Off, 1.0));
    check(Some(file), &["tracking.dynamic_filter=paper"], (DynamicFilter::Paper, 1.0));
    check(Some(file), &["mapping.resolution = 0.25"], (DynamicFilter::Off, 0.25));
    check(None, &["mapping.resolution=0.25", "mapping.resolution=1"], (DynamicFilter::Region, 1.0));
    check(None, &["tracking.dynamic_filter=\"off\""], (DynamicFilter::Off, 0.5));
    assert_eq!(
        settings(None, &["tracking.pose_models=pnp"]).map(|s| s.tracking.tracker.pose_models).ok(),
        Some(PoseModels::Pnp)
    );
}

#[test]
fn a_bad_setting_names_key_value_range_and_origin() {
    let check = |file, set: &[&str], parts: &[&str]| {
        let message = settings(file, set).map(|_| ()).expect_err(parts[0]).to_string();
        for part in parts {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    };
    check(None, &["mapping.resolution=2"], &["--set", "mapping.resolution = 2", "[0.125, 1]"]);
    check(None, &["mapping.resolution=nan"], &["--set", "mapping.resolution", "[0.125, 1]"]);
    check(None, &["mapping.resolution=-0.5"], &["-0.5", "[0.125, 1]"]);
    check(None, &["mapping.resolution=half"], &["half", "not a number"]);
    check(None, &["mapping.enabled=maybe"], &["mapping.enabled", "neither true nor false"]);
    check(None, &["tracking.matcher=orb"], &["tracking.matcher", "orb", "not a choice", "classical"]);
    check(None, &["tracking.dense_fallback=maybe"], &["maybe", "not a choice", "on"]);
    check(None, &["tracking.min_inliers=15.5"], &["tracking.min_inliers", "not a whole number", "[6, 200]"]);
    check(None, &["tracking.min_inliers=5"], &["tracking.min_inliers = 5", "[6, 200]"]);
    check(None, &["tracking.lk_levels=5"], &["tracking.lk_levels = 5", "[1, 4]"]);
    check(None, &["tracking.lk_max_backward_px=0"], &["tracking.lk_max_backward_px", "(0, 10]"]);
    check(None, &["tracking.confidence=1"], &["tracking.confidence", "[0.9, 1)"]);
    check(
        None,
        &["tracking.road_nearest_m=30"],
        &["tracking.road_farthest_m", "not above tracking.road_nearest_m = 30"],
    );
    check(
        None,
        &["mapping.stereo_nearest_m=20", "mapping.stereo_farthest_m=15"],
        &["--set", "mapping.stereo_farthest_m", "20"],
    );
    check(None, &["mapping.newest_share=0.9"], &["mapping.older_share", "0.9"]);
    check(None, &["mapping.resolutoin=1"], &["no setting mapping.resolutoin", "did you mean mapping.resolution?"]);
    check(None, &["x=1"], &["no setting x", "tracking.pose_models", "loop_closure.enabled"]);
    check(None, &["mapping.resolution"], &["--set", "has no ="]);
    check(Some("[mapping]\nresolution = 7\n"), &[], &["my.toml", "mapping.resolution = 7", "[0.125, 1]"]);
    check(Some("[mappings]\nresolution = 1\n"), &[], &["my.toml", "mappings.resolution", "did you mean"]);
    check(Some("resolution = 1\n"), &[], &["my.toml", "outside a section"]);
    check(Some("[mapping\n"), &[], &["my.toml", "not valid TOML", "line 1"]);
    let missing = load(&ConfigArgs { config: Some("/nowhere/my.toml".into()), set: vec![] }).map(|_| ());
    assert!(missing.unwrap_err().to_string().contains("/nowhere/my.toml"));
}

/// The comment lines right above each key of `default.toml`.
fn documented() -> Vec<(String, String)> {
    let (mut section, mut comment, mut found) = (String::new(), String::new(), vec![]);
    for line in DEFAULT_TOML.lines() {
        if let Some(name) = line.strip_prefix('[') {
            section = name.trim_end_matches(']').to_owned();
            comment.clear();
        } else if let Some(text) = line.strip_prefix('#') {
            comment.push_str(text);
        } else if line.is_empty() {
            comment.clear();
        } else if let Some((name, _)) = line.split_once('=') {
            found.push((format!("{section}.{}", name.trim()), std::mem::take(&mut comment)));
        }
    }
    found
}

#[test]
fn default_toml_tells_people_what_the_program_checks() {
    let documented = documented();
    let keys: Vec<_> = documented.iter().map(|(key, _)| key.as_str()).collect();
    let known: Vec<_> = SETTINGS.iter().map(|setting| setting.key).collect();
    assert_eq!(keys, known, "default.toml and the program must know the same settings in the same order");
    for (key, comment) in &documented {
        let setting = SETTINGS.iter().find(|setting| setting.key == key).expect("compared above");
        let sorted_choices = || {
            let list = comment.split("One of ").nth(1)?.split('.').next()?;
            let mut words: Vec<_> = list.split(", ").collect();
            words.sort_unstable();
            Some(words.join(", "))
        };
        let words = setting.values_in_words();
        assert!(
            comment.contains(&words) || sorted_choices().as_deref() == Some(words.as_str()),
            "{key}: the comment {comment:?} should say {words:?}"
        );
    }
}

/// The stages' own tests and measurements use constants in code; `default.toml` must say the same.
#[test]
fn the_defaults_are_the_values_that_the_stages_were_measured_with() {
    let measured = Settings::measured();
    let table: toml::Table = DEFAULT_TOML.parse().expect("valid TOML");
    let differs = |key: &str| {
        let (section, name) = key.split_once('.')?;
        let value = table.get(section)?.get(name)?;
        let mut settings = measured.clone();
        let setting = SETTINGS.iter().find(|setting| setting.key == key)?;
        setting.put(&mut settings, value).ok()?;
        (settings != measured)
            .then(|| format!("{key} = {value} in default.toml, another value in the stage's constants"))
    };
    let wrong: Vec<_> = SETTINGS.iter().filter_map(|setting| differs(setting.key)).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Which lines of the settings, written out, a number changes.
fn changed_lines(setting: &Setting) -> Vec<usize> {
    let values = match &setting.kind {
        Kind::Number { .. } => (0..160).map(|i| toml::Value::Float(0.0007 * 1.1_f64.powi(i))).collect::<Vec<_>>(),
        Kind::Whole { .. } => (1..1000).map(toml::Value::Integer).collect(),
        Kind::Choice { .. } | Kind::Switch { .. } | Kind::Text { .. } => return Vec::new(),
    };
    let measured = Settings::measured();
    let changed = values.iter().find_map(|value| {
        let mut settings = measured.clone();
        (setting.put(&mut settings, value).is_ok() && settings != measured).then_some(settings)
    });
    let written = [format!("{measured:#?}"), format!("{:#?}", changed.unwrap_or_else(|| measured.clone()))];
    let [before, after] = &written;
    before
        .lines()
        .zip(after.lines())
        .enumerate()
        .filter(|(_, (before, after))| before != after)
        .map(|(n, _)| n)
        .collect()
}

#[test]
fn every_number_reaches_its_own_field() {
    let mut owners = std::collections::BTreeMap::new();
    for setting in SETTINGS.iter().filter(|s| matches!(s.kind, Kind::Number { .. } | Kind::Whole { .. })) {
        let lines = changed_lines(setting);
        assert!(!lines.is_empty(), "{} changes nothing", setting.key);
        for line in lines {
            let other = owners.insert(line, setting.key);
            assert_eq!(other, None, "{} changes what another setting does", setting.key);
        }
    }
}
