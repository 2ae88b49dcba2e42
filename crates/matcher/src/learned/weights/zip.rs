//! The part of the zip format that PyTorch writes: stored files, no compression, no encryption.
//!
//! APPNOTE.TXT (PKWARE), sections 4.3.7, 4.3.12 and 4.3.16.

use super::bytes::{u16_at, u32_at};
use crate::learned::Error;
use std::collections::BTreeMap;

const FORMAT: &str = "PyTorch";
const MAX_FILES: usize = 8192;

/// The files of an archive.
pub(super) struct Archive<'a> {
    files: BTreeMap<&'a str, &'a [u8]>,
}

impl<'a> Archive<'a> {
    /// Reads the directory at the end of the archive.
    pub(super) fn new(bytes: &'a [u8]) -> Result<Self, Error> {
        let damaged = |problem: &str| Error::Damaged { format: FORMAT, problem: problem.into() };
        // The end record is 22 bytes and a comment of up to 64 KiB.
        let last = bytes.len().checked_sub(22).ok_or_else(|| damaged("it is too short"))?;
        let end = (last.saturating_sub(0xffff)..=last)
            .rev()
            .find(|&at| bytes.get(at..).is_some_and(|rest| rest.starts_with(b"PK\x05\x06")))
            .ok_or_else(|| damaged("the directory at its end is missing, so it is probably cut off"))?;
        let outside = || damaged("its directory points outside the file");
        let count = u16_at(bytes, end + 10).ok_or_else(outside)?;
        let mut at = u32_at(bytes, end + 16).ok_or_else(outside)?;
        if count > MAX_FILES || at == 0xffff_ffff {
            return Err(Error::Unsupported { format: FORMAT, what: "a directory of the zip64 kind".into() });
        }
        let mut files = BTreeMap::new();
        for _ in 0..count {
            let (name, content, next) = entry(bytes, at).ok_or_else(outside)?;
            let content = content.ok_or_else(|| Error::Unsupported {
                format: FORMAT,
                what: format!("the compressed or encrypted entry `{name}`"),
            })?;
            files.insert(name, content);
            at = next;
        }
        Ok(Self { files })
    }

    /// The file of this name.
    pub(super) fn get(&self, name: &str) -> Option<&'a [u8]> {
        self.files.get(name).copied()
    }

    /// The first file whose name ends like this, and what stands before.
    pub(super) fn find(&self, ending: &str) -> Option<(&'a str, &'a [u8])> {
        self.files.iter().find_map(|(name, content)| Some((name.strip_suffix(ending)?, *content)))
    }
}

/// Name, content (`None` if it is compressed or encrypted) and the place of the next entry of the directory.
type Entry<'a> = (&'a str, Option<&'a [u8]>, usize);

fn entry(bytes: &[u8], at: usize) -> Option<Entry<'_>> {
    if !bytes.get(at..)?.starts_with(b"PK\x01\x02") {
        return None;
    }
    let (flags, method) = (u16_at(bytes, at + 8)?, u16_at(bytes, at + 10)?);
    let (packed, size) = (u32_at(bytes, at + 20)?, u32_at(bytes, at + 24)?);
    let (name, extra, comment) = (u16_at(bytes, at + 28)?, u16_at(bytes, at + 30)?, u16_at(bytes, at + 32)?);
    let local = u32_at(bytes, at + 42)?;
    let text = std::str::from_utf8(bytes.get(at + 46..at + 46 + name)?).ok()?;
    let next = at + 46 + name + extra + comment;
    if method != 0 || flags & 1 != 0 || packed != size {
        return Some((text, None, next));
    }
    // The local header repeats the name with padding of its own, which aligns the content.
    if !bytes.get(local..)?.starts_with(b"PK\x03\x04") {
        return None;
    }
    let start = local + 30 + u16_at(bytes, local + 26)? + u16_at(bytes, local + 28)?;
    Some((text, Some(bytes.get(start..start.checked_add(size)?)?), next))
}
