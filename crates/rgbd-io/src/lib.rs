//! RGB-D sequences in, poses out.
//!
//! A tracker wants colour, depth in metres, a mask and a camera; a folder of files offers eight-bit depth, masks
//! of another size, a camera matrix of another resolution and a truncated last frame. This crate stands between
//! the two: what [`FrameSource::frame`] returns is consistent, and what can't be made consistent is an [`Error`]
//! that names the file and the remedy.
//!
//! ```
//! # #[cfg(feature = "codecs")] {
//! use rgbd_io::{CustomFolder, CustomOptions, CustomWriter, FrameSource, Image, Intrinsics};
//!
//! let dir = tempfile::tempdir()?;
//! let camera = Intrinsics { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };
//! let (grey, half_metre) = (Image::filled(64, 48, [90_u8; 3]), Image::filled(64, 48, 0.5_f32));
//! let mask = Image::from_fn(64, 48, |x, y| if (20..40).contains(&x) && (15..30).contains(&y) { 255 } else { 0 });
//! CustomWriter::create(dir.path(), &camera)?.write_frame("0000", &grey, &half_metre, Some(&mask))?;
//!
//! let folder = CustomFolder::open(dir.path(), &CustomOptions::default())?;
//! assert_eq!(folder.frame(0)?.depth[(30, 20)], 0.5);
//! println!("{}", rgbd_io::inspect(dir.path(), &CustomOptions::default()));
//! # }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The design decision: frames are decoded on demand, at random access, through `&self`. Everything that can be
//! checked cheaply is checked when a folder is opened, on its first frame, so a long run doesn't end in a typo; a
//! bad file further on is the error of that frame alone, and the caller decides whether to skip it.
//! [`ReadAhead`] hides the decoding time behind the caller's work.
//!
//! Feature `codecs` (on by default) reads and writes PNG and reads JPEG. Without it there remain the image and
//! camera types, [`poses`], [`ReadAhead`] and [`read_intrinsics`]. Feature `datasets` adds HO-3D, YCBInEOAT, BEHAVE,
//! BOP and TUM RGB-D with their truth.

mod cadence;
mod calibration;
mod error;
mod frame;
mod image;
mod intrinsics;
mod listing;
pub mod poses;
mod read_ahead;
mod registration;
mod sharpness;

#[cfg(feature = "codecs")]
mod codec;
#[cfg(feature = "codecs")]
mod custom;
#[cfg(feature = "datasets")]
pub mod datasets;
#[cfg(feature = "codecs")]
mod depth_units;
#[cfg(feature = "codecs")]
mod inspect;
#[cfg(feature = "codecs")]
mod layout;
#[cfg(feature = "codecs")]
mod writer;

pub use cadence::Cadence;
pub use calibration::{parse_intrinsics, read_intrinsics};
pub use error::Error;
pub use frame::{FrameSource, RgbdFrame};
pub use image::{Image, Mask};
pub use intrinsics::Intrinsics;
pub use read_ahead::ReadAhead;
pub use registration::{Registration, Shift};
pub use sharpness::{BLURRED, gray_sharpness, sharpness};

#[cfg(feature = "codecs")]
pub use codec::{
    read_color, read_depth_u16, read_mask, write_jpeg_rgb, write_png_depth, write_png_mask, write_png_rgb,
    write_png_u16,
};
#[cfg(feature = "codecs")]
pub use custom::CustomFolder;
#[cfg(feature = "codecs")]
pub use inspect::{DepthRange, Finding, Inspection, Severity, inspect};
#[cfg(feature = "codecs")]
pub use layout::{CustomOptions, MaskSource};
#[cfg(feature = "codecs")]
pub use writer::CustomWriter;

#[cfg(all(doctest, feature = "codecs"))]
#[doc = include_str!("../README.md")]
struct Readme;
