//! The pipe protocol by which another program segments: requests to it, replies from it, over any byte stream.
//!
//! Each message is one line of JSON and then raw bytes, row after row, without padding. Version 1:
//!
//! | message | header line | bytes after it |
//! |---|---|---|
//! | request `start` | `{"masks":1,"type":"start","id":"0000","width":W,"height":H}` | colour, depth, mask |
//! | request `frame` | `{"masks":1,"type":"frame","id":"0001","width":W,"height":H}` | colour, depth |
//! | reply to either | `{"masks":1,"width":w,"height":h,"confidence":c}` | mask |
//!
//! Colour is RGB, `3 W H` bytes; depth `4 W H` bytes of little-endian `f32` metres, 0 = missing; a mask one byte per
//! pixel, 0 = background. A reply's mask may have another size than the frame; `confidence` (0..1) may be left out
//! and is then 1. The reply to `start` repeats the first mask or improves it. When the requests end, the program ends.

use std::io::{BufRead, Read, Write};

use rgbd_io::{Image, Intrinsics, Mask, RgbdFrame};
use serde::{Deserialize, Serialize};

/// The version spoken here.
pub const VERSION: u32 = 1;
/// A header line is shorter than this; longer ones are no header.
const MAX_HEADER: u64 = 4096;
const MAX_PIXELS: usize = 1 << 27;

/// Why a conversation can't go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipeError {
    /// The stream broke or ended inside a message.
    #[error("the stream broke ({0}); see what the program wrote to its standard error")]
    Stream(#[from] std::io::Error),
    /// The stream ended where a reply was expected.
    #[error("the program ended without an answer; see what it wrote to its standard error")]
    Ended,
    /// Something that is no header of this protocol.
    #[error(
        "\"{line}\" is no message header ({problem}); the program must write messages only to its standard output"
    )]
    Header {
        /// The start of what was read.
        line: String,
        /// What is wrong with it.
        problem: String,
    },
    /// Another version of the protocol.
    #[error(
        "the program speaks version {0} of the protocol, this one is {VERSION}; update the older of the two"
    )]
    Version(u32),
    /// A size that no image has.
    #[error("a message of {width}x{height} pixels; images have between 1 and 2^27 of them")]
    Size {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// What the program is asked.
#[derive(Clone, Debug)]
pub enum Request {
    /// Begin with this mask of this frame.
    Start(RgbdFrame, Mask),
    /// Segment the next frame.
    Frame(RgbdFrame),
}

/// What the program answers.
#[derive(Clone, Debug, PartialEq)]
pub struct Reply {
    /// The mask, of any size; 0 = background.
    pub mask: Mask,
    /// How certain it is, 0..1.
    pub confidence: f32,
}

#[derive(Serialize, Deserialize)]
struct RequestHeader {
    masks: u32,
    #[serde(rename = "type")]
    kind: Kind,
    id: String,
    width: usize,
    height: usize,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Start,
    Frame,
}

#[derive(Serialize, Deserialize)]
struct ReplyHeader {
    masks: u32,
    width: usize,
    height: usize,
    #[serde(default = "certain")]
    confidence: f32,
}

fn certain() -> f32 {
    1.0
}

/// Writes a request; depth of another size than colour is sent as missing, a mask of another size as empty.
///
/// # Errors
/// When the stream breaks.
pub fn write_request(to: &mut impl Write, request: &Request) -> Result<(), PipeError> {
    let (kind, frame) = match request {
        Request::Start(frame, _) => (Kind::Start, frame),
        Request::Frame(frame) => (Kind::Frame, frame),
    };
    let (width, height) = frame.color.size();
    write_header(to, &RequestHeader { masks: VERSION, kind, id: frame.id.clone(), width, height })?;
    to.write_all(frame.color.pixels().as_flattened())?;
    let mut depth = vec![0u8; 4 * width * height];
    if frame.depth.size() == frame.color.size() {
        for (bytes, z) in depth.chunks_exact_mut(4).zip(frame.depth.pixels()) {
            bytes.copy_from_slice(&z.to_le_bytes());
        }
    }
    to.write_all(&depth)?;
    if let Request::Start(_, mask) = request {
        if mask.size() == frame.color.size() {
            to.write_all(mask.pixels())?;
        } else {
            to.write_all(&vec![0; width * height])?;
        }
    }
    Ok(to.flush()?)
}

/// Reads a request, the program's side; `None` when there are no more. The protocol carries no intrinsics.
///
/// # Errors
/// When the stream breaks or holds something else.
pub fn read_request(from: &mut impl BufRead) -> Result<Option<Request>, PipeError> {
    let Some(header) = read_header::<RequestHeader>(from, |h| h.masks)? else { return Ok(None) };
    let (width, height) = check_size(header.width, header.height)?;
    let color = read_bytes(from, 3 * width * height)?.as_chunks::<3>().0.to_vec();
    let depth = read_bytes(from, 4 * width * height)?;
    let depth = depth.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let frame = RgbdFrame {
        id: header.id,
        color: Image::from_vec(width, height, color).unwrap_or_default(),
        depth: Image::from_vec(width, height, depth).unwrap_or_default(),
        mask: None,
        intrinsics: Intrinsics { fx: 0.0, fy: 0.0, cx: 0.0, cy: 0.0 },
    };
    Ok(Some(match header.kind {
        Kind::Start => Request::Start(frame, read_mask(from, width, height)?),
        Kind::Frame => Request::Frame(frame),
    }))
}

/// Writes a reply, the program's side.
///
/// # Errors
/// When the stream breaks.
pub fn write_reply(to: &mut impl Write, reply: &Reply) -> Result<(), PipeError> {
    let (width, height) = reply.mask.size();
    write_header(to, &ReplyHeader { masks: VERSION, width, height, confidence: reply.confidence })?;
    to.write_all(reply.mask.pixels())?;
    Ok(to.flush()?)
}

/// Reads a reply.
///
/// # Errors
/// When the stream breaks or ends, or holds something else.
pub fn read_reply(from: &mut impl BufRead) -> Result<Reply, PipeError> {
    let header = read_header::<ReplyHeader>(from, |h| h.masks)?.ok_or(PipeError::Ended)?;
    let (width, height) = check_size(header.width, header.height)?;
    let mask = read_mask(from, width, height)?;
    let confidence = if header.confidence.is_finite() { header.confidence.clamp(0.0, 1.0) } else { 0.0 };
    Ok(Reply { mask, confidence })
}

fn write_header(to: &mut impl Write, header: &impl Serialize) -> Result<(), PipeError> {
    let mut line = serde_json::to_vec(header).map_err(std::io::Error::from)?;
    line.push(b'\n');
    Ok(to.write_all(&line)?)
}

fn read_header<H: for<'a> Deserialize<'a>>(
    from: &mut impl BufRead,
    version: impl Fn(&H) -> u32,
) -> Result<Option<H>, PipeError> {
    let mut line = Vec::new();
    from.by_ref().take(MAX_HEADER).read_until(b'\n', &mut line)?;
    if line.is_empty() {
        return Ok(None);
    }
    let shown = || String::from_utf8_lossy(&line).trim_end().chars().take(60).collect::<String>();
    let failed = |problem: String| PipeError::Header { line: shown(), problem };
    if line.last() != Some(&b'\n') {
        return Err(failed("the line doesn't end".into()));
    }
    // Another version may have other fields: the version is looked at first.
    let value: serde_json::Value = serde_json::from_slice(&line).map_err(|e| failed(e.to_string()))?;
    match value["masks"].as_u64() {
        Some(v) if v != u64::from(VERSION) => {
            return Err(PipeError::Version(v.try_into().unwrap_or(u32::MAX)));
        }
        _ => {}
    }
    let header: H = serde_json::from_value(value).map_err(|e| failed(e.to_string()))?;
    debug_assert_eq!(version(&header), VERSION);
    Ok(Some(header))
}

fn check_size(width: usize, height: usize) -> Result<(usize, usize), PipeError> {
    match width.checked_mul(height) {
        Some(1..=MAX_PIXELS) => Ok((width, height)),
        _ => Err(PipeError::Size { width, height }),
    }
}

/// Reads as it comes: a wrong size must not reserve gigabytes.
fn read_bytes(from: &mut impl Read, count: usize) -> Result<Vec<u8>, PipeError> {
    let mut bytes = Vec::new();
    from.take(count as u64).read_to_end(&mut bytes)?;
    if bytes.len() < count {
        return Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof).into());
    }
    Ok(bytes)
}

fn read_mask(from: &mut impl Read, width: usize, height: usize) -> Result<Mask, PipeError> {
    Ok(Image::from_vec(width, height, read_bytes(from, width * height)?).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(width: usize, height: usize) -> RgbdFrame {
        RgbdFrame {
            id: "a \"quoted\"\nname".into(),
            color: Image::from_fn(width, height, |x, y| [x as u8, y as u8, 10]),
            depth: Image::from_fn(width, height, |x, y| 0.1 + (x * y) as f32),
            mask: None,
            intrinsics: Intrinsics { fx: 0.0, fy: 0.0, cx: 0.0, cy: 0.0 },
        }
    }

    proptest! {
        #[test]
        fn messages_survive_the_stream(width in 1usize..20, height in 1usize..20, confidence in 0.0f32..1.0) {
            let mask = Image::from_fn(width, height, |x, y| ((x + y) % 3) as u8);
            let frame = frame(width, height);
            let mut stream = Vec::new();
            for request in [Request::Start(frame.clone(), mask.clone()), Request::Frame(frame)] {
                stream.clear();
                write_request(&mut stream, &request).unwrap();
                let mut from = stream.as_slice();
                let again = read_request(&mut from).unwrap().unwrap();
                let parts = |r: &Request| match r {
                    Request::Start(f, m) => (f.id.clone(), f.color.clone(), f.depth.clone(), Some(m.clone())),
                    Request::Frame(f) => (f.id.clone(), f.color.clone(), f.depth.clone(), None),
                };
                prop_assert_eq!(parts(&again), parts(&request));
                prop_assert!(read_request(&mut from).unwrap().is_none());
            }
            let reply = Reply { mask, confidence };
            stream.clear();
            write_reply(&mut stream, &reply).unwrap();
            prop_assert_eq!(read_reply(&mut stream.as_slice()).unwrap(), reply);
        }

        #[test]
        fn garbage_is_an_error_and_nothing_worse(bytes in prop::collection::vec(any::<u8>(), 1..200)) {
            let _ = read_reply(&mut bytes.as_slice());
            let _ = read_request(&mut bytes.as_slice());
        }
    }

    #[test]
    fn what_is_wrong_is_said() {
        let error = |bytes: &[u8]| read_reply(&mut &*bytes).unwrap_err().to_string();
        assert!(error(b"").contains("without an answer"));
        assert!(error(b"loading model\n").contains("\"loading model\" is no message header"));
        assert!(error(b"{\"masks\":2}\n").contains("version 2"));
        assert!(error(b"{\"masks\":1,\"width\":2,\"height\":2}\n123").contains("broke"));
        assert!(error(b"{\"masks\":1,\"width\":0,\"height\":2}\n").contains("0x2"));
        assert!(error(b"{\"masks\":1,\"width\":99999999,\"height\":99999999}\n").contains("2^27"));
        assert!(error(&[b'x'; 5000]).contains("doesn't end"));
        let reply = read_reply(&mut &b"{\"masks\":1,\"width\":1,\"height\":1}\n\x07"[..]).unwrap();
        assert_eq!(reply.confidence, 1.0);
    }
}
