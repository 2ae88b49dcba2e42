//! Small texts: camera matrices, poses, TUM's lists, the config, a matcher's name. The first byte chooses.

use crate::bytes::Bytes;
use crate::check_pose;
use bundlesdf::Config;
use matcher::learned::MatcherSpec;
use rgbd_io::datasets::tum;
use rgbd_io::poses::{format_pose, parse_pose};

pub(crate) fn run(data: &[u8]) {
    let mut bytes = Bytes(data);
    let parser = bytes.below(6);
    let text = String::from_utf8_lossy(bytes.rest());
    match parser {
        0 => {
            let Ok(camera) = rgbd_io::parse_intrinsics(&text) else { return };
            assert!(camera.is_valid());
        }
        1 => {
            let Ok(pose) = parse_pose(&text) else { return };
            check_pose(&pose);
            assert!(parse_pose(&format_pose(&pose)).is_ok(), "what was written can't be read");
        }
        2 => {
            let Ok(list) = tum::parse_list(&text) else { return };
            let times: Vec<f64> = list.iter().map(|(time, _)| *time).collect();
            assert!(times.is_sorted());
            let pairs = tum::associate(&times, &times, tum::MAX_TIME_DIFFERENCE);
            assert!(pairs.len() <= times.len());
        }
        3 => {
            let Ok(poses) = tum::parse_trajectory(&text) else { return };
            assert!(poses.is_sorted_by(|a, b| a.0 <= b.0));
            poses.iter().for_each(|(_, pose)| check_pose(pose));
        }
        4 => {
            let Ok(config) = Config::from_toml(&text, "config.toml") else { return };
            let written = toml::to_string(&config);
            assert!(written.is_ok(), "{written:?}");
            let Ok(written) = written else { return };
            let read = Config::from_toml(&written, "config.toml");
            assert!(read.as_ref().is_ok_and(|read| *read == config), "{written}\n{read:?}");
        }
        _ => {
            let Ok(spec) = text.parse::<MatcherSpec>() else { return };
            assert!(spec.to_string().parse::<MatcherSpec>().is_ok_and(|again| again == spec));
        }
    }
}
