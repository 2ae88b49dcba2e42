//! Correspondences between two views of one rigid object, and the rigid motion they imply.
//!
//! The object is small in the image, its mask is known, its pose is roughly known, and it may turn in the image
//! plane. A matcher made for whole photographs wastes its resolution on the background and fails under roll. This
//! crate first cuts a tight crop out of each view, turned by the roll that the current poses predict
//! ([`RollCrop`]), matches inside the crops ([`FeatureMatcher`]) and reports pixels of the source images. Between
//! neighbouring frames, corners are followed instead ([`klt`]). Lifted to 3-D, the matches vote for one rigid motion
//! ([`ransac`]).
//!
//! ```
//! use matcher::{CropOptions, FeatureMatcher, RollCrop, ScaleSpaceMatcher};
//! use rgbd_io::{Image, Mask};
//!
//! // Two views of one texture, the second shifted by (6, 4) pixels.
//! let texture = |x: f32, y: f32| {
//!     let wave = |k: f32| 24.0 * (0.3 * (x * (k * k).cos() + y * (k * k).sin()) + 7.0 * k).sin();
//!     128.0 + (1..9).map(|k| wave(k as f32)).sum::<f32>()
//! };
//! let view = |dx: f32, dy: f32| Image::from_fn(160, 120, |x, y| texture(x as f32 - dx, y as f32 - dy));
//! let mask = Mask::filled(160, 120, 1);
//!
//! let matcher = ScaleSpaceMatcher::default();
//! let options = CropOptions::default();
//! let crop = |gray: &Image<f32>| RollCrop::new(gray, &mask, 0.0, &options).ok_or("empty mask");
//! let a = matcher.detect(&crop(&view(0.0, 0.0))?);
//! let b = matcher.detect(&crop(&view(6.0, 4.0))?);
//! let matches = matcher.match_features(&a, &b);
//! let good = matches.iter().filter(|m| (m.b[0] - m.a[0] - 6.0).hypot(m.b[1] - m.a[1] - 4.0) < 2.0).count();
//! assert!(matches.len() > 10 && good * 10 >= matches.len() * 9);
//! # Ok::<(), &str>(())
//! ```
//!
//! The design decision: **everything works in the object's frame of reference**. Crops remove roll and scale before
//! pixels are compared, and [`ransac`] takes points that are already in the object frame under the current poses, so
//! that its gates act on the *residual* motion, whatever the distance to the camera. "No features", "no matches" and
//! "no model" are ordinary results, never errors: a plain white cup is a legitimate object.
//!
//! Feature `learned` (on by default): `learned`, the networks EdgePoint2 and XFeat as matchers, for weights that the
//! caller has.

mod blur;
pub mod corners;
pub mod crop;
mod descriptor;
mod fill;
pub mod gray;
pub mod klt;
#[cfg(feature = "learned")]
pub mod learned;
pub mod matching;
pub mod ransac;
pub mod scale_space;
mod simd;
mod window;

pub use corners::{CornerOptions, detect_corners, detect_new_corners};
pub use crop::{CropOptions, RollCrop, roll_between};
pub use gray::{Pyramid, Rect, to_gray, to_gray_rect};
pub use klt::{KltOptions, Track, track, track_forward_backward};
pub use matching::{Descriptors, FeatureMatcher, Features, Match};
pub use ransac::{LiftedMatch, RansacOptions, RigidModel};
pub use scale_space::{Orientation, ScaleSpaceMatcher, ScaleSpaceOptions};

#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
