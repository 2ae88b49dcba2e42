//! Where masks come from: the built-in segmenter, a folder, or another program.

mod command;
mod folder;

use std::path::PathBuf;
use std::sync::Arc;

use mask_tracker::{Propagate, VideoSegmenter};
use rgbd_io::{Error, FrameSource};

pub use command::{CommandSegmenter, Patience};
pub use folder::FolderSegmenter;

/// Called with what went wrong when a segmenter hands over to the built-in one.
pub type OnTrouble = Arc<dyn Fn(&str) + Send + Sync>;

/// The choice of a segmenter; written `propagate`, `folder:DIR` or `command:PROGRAM ARGUMENTS`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum SegmenterChoice {
    /// The built-in one.
    #[default]
    Propagate,
    /// A folder of masks, of any naming and size.
    Folder(PathBuf),
    /// A program that speaks [`mask_tracker::pipe`], with its arguments.
    Command(Vec<String>),
}

impl std::str::FromStr for SegmenterChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once(':') {
            None if text == "propagate" => Ok(Self::Propagate),
            Some(("folder", dir)) if !dir.is_empty() => Ok(Self::Folder(dir.into())),
            Some(("command", line)) => match shell_words::split(line) {
                Ok(words) if !words.is_empty() => Ok(Self::Command(words)),
                Ok(_) => Err("command: needs a program, such as \"command:python adapter.py\"".into()),
                Err(error) => Err(format!("the command can't be split into words: {error}")),
            },
            _ => Err("use propagate, folder:DIR or command:PROGRAM".into()),
        }
    }
}

impl SegmenterChoice {
    /// The segmenter for the frames of `source`; `on_trouble` hears when it hands over to the built-in one.
    ///
    /// # Errors
    /// When a folder's masks can't be matched with the frames, or a program can't be started.
    pub fn build(
        &self,
        source: &dyn FrameSource,
        on_trouble: OnTrouble,
    ) -> Result<Box<dyn VideoSegmenter>, Error> {
        Ok(match self {
            Self::Propagate => Box::new(Propagate::default()),
            Self::Folder(dir) => Box::new(FolderSegmenter::open(dir, source, on_trouble)?),
            Self::Command(words) => {
                Box::new(CommandSegmenter::spawn(words, Patience::default(), on_trouble)?)
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read() {
        assert_eq!("propagate".parse(), Ok(SegmenterChoice::Propagate));
        assert_eq!("folder:a/b".parse(), Ok(SegmenterChoice::Folder("a/b".into())));
        let words = ["python", "my adapter.py", "--fast"].map(String::from).to_vec();
        assert_eq!("command:python 'my adapter.py' --fast".parse(), Ok(SegmenterChoice::Command(words)));
        for wrong in ["", "folder:", "command:", "command:'open", "xmem"] {
            assert!(wrong.parse::<SegmenterChoice>().is_err(), "{wrong}");
        }
    }
}
