//! The rooms keep to themselves: outside libraries are named only where the design says, and imports point down only.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// From the outside in.
const ROOMS: [&str; 15] = [
    "commands",
    "service",
    "wire",
    "evaluation",
    "dataset",
    "simulation",
    "pipeline",
    "engine",
    "memory",
    "stages",
    "config",
    "model",
    "lanes",
    "pool",
    "isa",
];

/// A crate, and the only paths below `src` that may name it.
const OUTSIDERS: [(&str, &[&str]); 7] = [
    ("zenoh", &["service/", "wire/keys.rs"]),
    ("axum", &["service/http/"]),
    ("prost", &["wire/"]),
    ("wgpu", &["engine/gpu"]),
    ("prometheus_client", &["service/metrics", "service/http/"]),
    ("utoipa", &["service/"]),
    ("object_store", &["memory/store/"]),
];

fn sources() -> Vec<(String, String)> {
    fn walk(folder: &Path, files: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).expect("src can be read") {
            let path = entry.expect("src can be read").path();
            if path.is_dir() {
                walk(&path, files);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                files.push(path);
            }
        }
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    walk(&root, &mut files);
    assert!(files.len() > 20, "the sources were found");
    files
        .into_iter()
        .map(|file| {
            let text = fs::read_to_string(&file).expect("sources are text");
            let name = file.strip_prefix(&root).expect("below src");
            (name.to_string_lossy().into_owned(), code(&text))
        })
        .collect()
}

/// Without comments and without the tests at a file's end.
fn code(text: &str) -> String {
    text.lines()
        .take_while(|line| line.trim() != "#[cfg(test)]")
        .map(|line| match line.find("//") {
            Some(comment) => &line[..comment],
            None => line,
        })
        .collect::<Vec<_>>()
        .join("\n")
}

/// Whether `text` uses `name` as the first part of a path.
fn names(text: &str, name: &str) -> bool {
    text.match_indices(name).any(|(at, _)| {
        let before = text[..at].chars().next_back();
        let after = &text[at + name.len()..];
        before.is_none_or(|c| !c.is_alphanumeric() && c != '_' && c != ':')
            && after.starts_with("::")
    })
}

/// The rooms that a file's `crate::` paths lead to.
fn rooms_used(text: &str) -> Vec<&'static str> {
    let mut used = Vec::new();
    for (at, _) in text.match_indices("crate::") {
        let path = &text[at + "crate::".len()..];
        let heads: Vec<&str> = match path.strip_prefix('{') {
            None => vec![path],
            Some(list) => top_level(list),
        };
        for head in heads {
            let head = head.trim_start();
            used.extend(ROOMS.iter().find(|room| {
                head.strip_prefix(**room).is_some_and(|rest| {
                    !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_')
                })
            }));
        }
    }
    used
}

/// The parts of `a::{b, c}, d}...` that are not inside inner braces.
fn top_level(list: &str) -> Vec<&str> {
    let (mut parts, mut depth, mut start) = (Vec::new(), 0, 0);
    for (at, c) in list.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => {
                parts.push(&list[start..at]);
                break;
            }
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&list[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts
}

#[test]
fn outside_libraries_are_named_only_in_their_rooms() {
    for (file, text) in sources() {
        for (library, rooms) in OUTSIDERS {
            if !rooms.iter().any(|room| file.starts_with(room)) {
                assert!(
                    !names(&text, library),
                    "src/{file} names {library}, which belongs to {rooms:?}"
                );
            }
        }
    }
}

#[test]
fn imports_point_down_only() {
    for (file, text) in sources() {
        let room = file.split(['/', '.']).next().expect("a name has parts");
        let Some(own) = ROOMS.iter().position(|known| *known == room) else {
            assert!(
                matches!(room, "main" | "lib"),
                "src/{file} is in no known room"
            );
            continue;
        };
        for used in rooms_used(&text) {
            let other = ROOMS.iter().position(|known| *known == used);
            assert!(
                other >= Some(own),
                "src/{file} in `{room}` imports from `{used}`, which is above it"
            );
        }
    }
}

#[test]
fn nothing_unwraps_outside_tests() {
    for (file, text) in sources() {
        assert!(!text.contains(".unwrap()"), "src/{file} unwraps");
    }
}

#[test]
fn the_checks_see_what_they_look_for() {
    assert!(names("use zenoh::Session;", "zenoh"));
    assert!(!names("use my_zenoh::x; service::zenoh::y", "zenoh"));
    assert_eq!(
        rooms_used("use crate::{\n    model::{a, wire::b},\n    stages::c,\n};\ncrate::config::x"),
        ["model", "stages", "config"]
    );
    assert!(rooms_used("use crate::modeling::x;").is_empty());
}
