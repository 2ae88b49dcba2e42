//! Frames as one moving picture: GIF by itself, MP4, WebM and WebP through ffmpeg.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
};

use rgbd_io::Image;

/// Why an animation could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AnimationError {
    /// The file's name has no known ending.
    #[error("{}: isn't .gif, .webp, .mp4 or .webm; give a name that ends in one of these", .0.display())]
    UnknownFormat(PathBuf),
    /// The format needs ffmpeg.
    #[error("{}: needs ffmpeg, which can't be started ({reason}); install it, or use .gif", path.display())]
    NoFfmpeg {
        /// The animation.
        path: PathBuf,
        /// Why it can't be started.
        reason: std::io::Error,
    },
    /// The file can't be written.
    #[error("{}: can't be written ({problem}); check the folder and the space on the disk", path.display())]
    Write {
        /// The animation.
        path: PathBuf,
        /// What went wrong.
        problem: String,
    },
}

/// An animation under way: frames of one size, pushed in order, then [`Animation::finish`].
pub struct Animation {
    path: PathBuf,
    size: (usize, usize),
    delay_ms: u32,
    sink: Sink,
}

enum Sink {
    /// The encoder starts with the first frame, whose size it takes.
    Gif(Option<gif::Encoder<BufWriter<File>>>),
    Ffmpeg(Option<Child>),
}

impl Animation {
    /// Widest picture of a GIF (pixels): 256 colours and no motion compensation make larger ones unwieldy.
    pub const GIF_WIDTH: usize = 480;

    /// Starts a file; its ending decides the format.
    ///
    /// # Errors
    /// When the ending is unknown.
    pub fn create(path: &Path, frames_per_second: f64) -> Result<Self, AnimationError> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let sink = match ending.as_str() {
            "gif" => Sink::Gif(None),
            "webp" | "mp4" | "webm" => Sink::Ffmpeg(None),
            _ => return Err(AnimationError::UnknownFormat(path.to_owned())),
        };
        let delay_ms = (1000.0 / frames_per_second.clamp(0.1, 100.0)).round() as u32;
        Ok(Self { path: path.to_owned(), size: (0, 0), delay_ms, sink })
    }

    /// Adds a frame; one of another size than the first is left out.
    ///
    /// # Errors
    /// When it can't be written, or ffmpeg can't be started.
    pub fn push(&mut self, image: &Image<[u8; 3]>) -> Result<(), AnimationError> {
        if self.size == (0, 0) {
            self.size = image.size();
            self.start()?;
        }
        if image.size() != self.size {
            return Ok(());
        }
        let (width, height) = self.size;
        let bytes = image.pixels().as_flattened();
        let result = match &mut self.sink {
            Sink::Gif(Some(encoder)) => {
                let mut frame = gif::Frame::from_rgb_speed(width as u16, height as u16, bytes, 10);
                frame.delay = self.delay_ms.div_ceil(10) as u16;
                encoder.write_frame(&frame).map_err(|e| e.to_string())
            }
            Sink::Ffmpeg(Some(child)) => match &mut child.stdin {
                Some(pipe) => pipe.write_all(bytes).map_err(|e| format!("ffmpeg stopped reading: {e}")),
                None => Err("ffmpeg has no input".to_owned()),
            },
            _ => Ok(()),
        };
        result.map_err(|problem| AnimationError::Write { path: self.path.clone(), problem })
    }

    /// Completes the file.
    ///
    /// # Errors
    /// When it can't be written, or ffmpeg fails.
    pub fn finish(mut self) -> Result<(), AnimationError> {
        let failed = |problem: String| AnimationError::Write { path: self.path.clone(), problem };
        match &mut self.sink {
            Sink::Gif(encoder) => match encoder.take() {
                Some(encoder) => {
                    let mut file = encoder.into_inner().map_err(|e| failed(e.to_string()))?;
                    file.flush().map_err(|e| failed(e.to_string()))
                }
                None => Err(failed("there was no frame".into())),
            },
            Sink::Ffmpeg(child) => {
                let Some(child) = child.take() else { return Err(failed("there was no frame".into())) };
                let output = child.wait_with_output().map_err(|e| failed(e.to_string()))?;
                let said = String::from_utf8_lossy(&output.stderr);
                let last = said.lines().last().unwrap_or("it gave no reason");
                if output.status.success() { Ok(()) } else { Err(failed(format!("ffmpeg failed: {last}"))) }
            }
        }
    }

    fn start(&mut self) -> Result<(), AnimationError> {
        let (width, height) = self.size;
        let failed = |problem: String| AnimationError::Write { path: self.path.clone(), problem };
        match &mut self.sink {
            Sink::Gif(encoder) => {
                let (Ok(w), Ok(h)) = (u16::try_from(width), u16::try_from(height)) else {
                    return Err(failed("GIF pictures have at most 65535 rows and columns".into()));
                };
                let file = File::create(&self.path).map_err(|e| failed(e.to_string()))?;
                let mut started =
                    gif::Encoder::new(BufWriter::new(file), w, h, &[]).map_err(|e| failed(e.to_string()))?;
                started.set_repeat(gif::Repeat::Infinite).map_err(|e| failed(e.to_string()))?;
                *encoder = Some(started);
            }
            Sink::Ffmpeg(child) => {
                let started = ffmpeg(&self.path, self.size, self.delay_ms)
                    .spawn()
                    .map_err(|reason| AnimationError::NoFfmpeg { path: self.path.clone(), reason })?;
                *child = Some(started);
            }
        }
        Ok(())
    }
}

/// Reads raw RGB from its input; the format follows from the name of the output.
fn ffmpeg(path: &Path, (width, height): (usize, usize), delay_ms: u32) -> Command {
    let mut command = Command::new("ffmpeg");
    let rate = format!("1000/{}", delay_ms.max(1));
    let size = format!("{width}x{height}");
    command.args([
        "-y",
        "-loglevel",
        "error",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        &size,
        "-r",
        &rate,
    ]);
    command.args(["-i", "-"]);
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("webp")) {
        command.args(["-loop", "0", "-quality", "80"]);
    } else {
        // What every player takes: even sizes, 4:2:0.
        command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]);
    }
    command.arg(path).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gif_holds_every_frame_of_one_size() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.gif");
        let mut animation = Animation::create(&path, 10.0).unwrap();
        for shade in [0, 120, 250] {
            animation.push(&Image::filled(32, 20, [shade, 40, 90])).unwrap();
        }
        animation.push(&Image::filled(10, 10, [0; 3])).unwrap();
        animation.finish().unwrap();
        let mut decoder = gif::DecodeOptions::new().read_info(File::open(&path).unwrap()).unwrap();
        assert_eq!((decoder.width(), decoder.height()), (32, 20));
        let mut delays = Vec::new();
        while let Some(frame) = decoder.next_frame_info().unwrap() {
            delays.push(frame.delay);
        }
        assert_eq!(delays, [10, 10, 10]);
    }

    #[test]
    fn an_unknown_ending_is_refused_and_an_empty_animation_too() {
        let error = Animation::create(Path::new("a.avi"), 10.0).err().unwrap().to_string();
        assert!(error.contains("a.avi") && error.contains(".gif"), "{error}");
        let dir = tempfile::tempdir().unwrap();
        assert!(Animation::create(&dir.path().join("a.gif"), 10.0).unwrap().finish().is_err());
    }
}
