//! safetensors: the length of a JSON header, the header, the numbers.

use super::bytes::{array, floats};
use super::{MAX_DIMENSIONS, MAX_TENSORS, Tensor};
use crate::learned::Error;
use std::collections::BTreeMap;

const FORMAT: &str = "safetensors";
const MAX_HEADER: u64 = 1 << 22;

/// All 32-bit float tensors of the file.
pub(super) fn parse(bytes: &[u8]) -> Result<BTreeMap<String, Tensor>, Error> {
    let damaged = |problem: &str| Error::Damaged { format: FORMAT, problem: problem.into() };
    let length = array(bytes, 0).map(u64::from_le_bytes).ok_or_else(|| damaged("it is too short"))?;
    if length > MAX_HEADER {
        return Err(damaged("its header is too long"));
    }
    let end = 8 + usize::try_from(length).unwrap_or(usize::MAX - 8);
    let short = || damaged("it ends inside its header");
    let header = bytes.get(8..end).ok_or_else(short)?;
    let text = std::str::from_utf8(header).map_err(|_| damaged("its header is not UTF-8"))?;
    let data = bytes.get(end..).ok_or_else(short)?;
    let entries = Json { text, at: 0 }.header().ok_or_else(|| damaged("its header is not as specified"))?;
    let (mut tensors, mut total) = (BTreeMap::new(), 0_usize);
    for Entry { name, dtype, shape, offsets: [from, to] } in entries {
        let wrong = |problem: &str| damaged(&format!("tensor `{name}` {problem}"));
        match dtype.as_str() {
            "F32" => {}
            "I64" | "I32" | "I16" | "I8" | "U8" | "BOOL" => continue,
            other => {
                return Err(Error::Unsupported { format: FORMAT, what: format!("numbers of type {other}") });
            }
        }
        let count = shape.iter().try_fold(1_usize, |n, d| n.checked_mul(*d)).and_then(|n| n.checked_mul(4));
        let content = data.get(from..to).ok_or_else(|| wrong("lies outside the file"))?;
        if count != Some(content.len()) {
            return Err(wrong("has another size than its shape says"));
        }
        total += content.len();
        // Tensors lie side by side: what overlaps could fill the memory from a small file.
        if total > data.len() {
            return Err(wrong("overlaps another"));
        }
        tensors.insert(name, Tensor { shape, values: floats(content) });
    }
    Ok(tensors)
}

/// What the header says about a tensor.
#[derive(Default)]
struct Entry {
    name: String,
    dtype: String,
    shape: Vec<usize>,
    offsets: [usize; 2],
}

/// The JSON that the format allows: an object of tensors and an object of strings called `__metadata__`.
struct Json<'a> {
    text: &'a str,
    at: usize,
}

impl<'t> Json<'t> {
    fn header(&mut self) -> Option<Vec<Entry>> {
        let mut entries = Vec::new();
        self.object(|json, name| {
            if name == "__metadata__" {
                return json.object(|json, _| json.string().map(|_| ()));
            }
            let mut entry = Entry { name, ..Entry::default() };
            json.object(|json, key| {
                match key.as_str() {
                    "dtype" => entry.dtype = json.string()?,
                    "shape" => entry.shape = json.numbers()?,
                    "data_offsets" => entry.offsets = json.numbers()?.try_into().ok()?,
                    _ => return None,
                }
                Some(())
            })?;
            entries.push(entry);
            (entries.len() <= MAX_TENSORS).then_some(())
        })?;
        Some(entries)
    }

    /// An object whose values are read by `value`, which is given the key.
    fn object(&mut self, mut value: impl FnMut(&mut Self, String) -> Option<()>) -> Option<()> {
        self.eat('{')?;
        if self.eat('}').is_some() {
            return Some(());
        }
        loop {
            let key = self.string()?;
            self.eat(':')?;
            value(self, key)?;
            if self.eat(',').is_none() {
                return self.eat('}');
            }
        }
    }

    fn numbers(&mut self) -> Option<Vec<usize>> {
        let mut numbers = Vec::new();
        self.eat('[')?;
        if self.eat(']').is_some() {
            return Some(numbers);
        }
        while numbers.len() < MAX_DIMENSIONS {
            self.skip_spaces();
            let rest = self.rest();
            let digits = rest.len() - rest.trim_start_matches(|c: char| c.is_ascii_digit()).len();
            numbers.push(rest.get(..digits)?.parse().ok()?);
            self.at += digits;
            if self.eat(',').is_none() {
                return self.eat(']').map(|()| numbers);
            }
        }
        None
    }

    fn string(&mut self) -> Option<String> {
        self.eat('"')?;
        let mut out = String::new();
        let mut characters = self.rest().char_indices();
        while let Some((i, c)) = characters.next() {
            match c {
                '"' => {
                    self.at += i + 1;
                    return Some(out);
                }
                '\\' => match characters.next()?.1 {
                    c @ ('"' | '\\' | '/') => out.push(c),
                    'n' => out.push('\n'),
                    't' => out.push('\t'),
                    'r' => out.push('\r'),
                    'b' => out.push('\u{8}'),
                    'f' => out.push('\u{c}'),
                    'u' => {
                        let code =
                            (0..4).try_fold(0, |n, _| Some(n * 16 + characters.next()?.1.to_digit(16)?))?;
                        out.push(char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER));
                    }
                    _ => return None,
                },
                c => out.push(c),
            }
        }
        None
    }

    fn eat(&mut self, wanted: char) -> Option<()> {
        self.skip_spaces();
        let rest = self.rest().strip_prefix(wanted)?;
        self.at = self.text.len() - rest.len();
        Some(())
    }

    fn skip_spaces(&mut self) {
        self.at = self.text.len() - self.rest().trim_start_matches([' ', '\n', '\r', '\t']).len();
    }

    /// What is not read yet.
    fn rest(&self) -> &'t str {
        self.text.get(self.at..).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    pub(crate) fn file(header: &str, data: &[f32]) -> Vec<u8> {
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend_from_slice(header.as_bytes());
        bytes.extend(data.iter().flat_map(|v| v.to_le_bytes()));
        bytes
    }

    const HEADER: &str = r#" {"__metadata__":{"a":"b\"\u00e9"}, "x.y": {"dtype":"F32","shape":[2, 1],"data_offsets":[0,8]},
        "n":{"dtype":"I64","shape":[],"data_offsets":[0,8]}, "s":{"data_offsets":[8,12],"shape":[],"dtype":"F32"} } "#;

    #[test]
    fn tensors_are_read() {
        let tensors = parse(&file(HEADER, &[1.5, -2.0, 3.0])).unwrap();
        assert_eq!(tensors.len(), 2);
        assert_eq!(tensors["x.y"], Tensor { shape: vec![2, 1], values: vec![1.5, -2.0] });
        assert_eq!(tensors["s"], Tensor { shape: vec![], values: vec![3.0] });
    }

    #[test]
    fn damage_is_told() {
        let whole = file(HEADER, &[1.5, -2.0, 3.0]);
        for cut in [4, 40, whole.len() - 1] {
            let error = parse(&whole[..cut]).unwrap_err();
            assert!(matches!(error, Error::Damaged { .. }), "{error}");
        }
        let half = r#"{"x":{"dtype":"F16","shape":[2],"data_offsets":[0,4]}}"#;
        assert!(matches!(parse(&file(half, &[0.0])), Err(Error::Unsupported { .. })));
        let huge = r#"{"x":{"dtype":"F32","shape":[4294967296,4294967296,4],"data_offsets":[0,4]}}"#;
        assert!(matches!(parse(&file(huge, &[0.0])), Err(Error::Damaged { .. })));
        // The same numbers as two tensors, and so on: a small file that fills the memory.
        let twice = r#"{"x":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"y":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#;
        assert!(parse(&file(twice, &[0.0])).unwrap_err().to_string().contains("overlaps"));
        let reversed = r#"{"x":{"dtype":"F32","shape":[1],"data_offsets":[4,0]}}"#;
        assert!(matches!(parse(&file(reversed, &[0.0])), Err(Error::Damaged { .. })));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn no_change_of_a_header_panics(at in 0..HEADER.len(), with in any::<u8>()) {
            let mut bytes = file(HEADER, &[1.5, -2.0, 3.0]);
            bytes[8 + at] = with;
            let _ = parse(&bytes);
        }
    }
}
