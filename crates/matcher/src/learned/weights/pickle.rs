//! State dicts from the pickle inside a PyTorch archive, without running anything.
//!
//! A pickle is a program for a stack machine (documented in CPython's `pickletools`). A state dict needs numbers,
//! strings, tuples, dicts, references to storages, and two functions: the one that makes an ordered dict and the one that
//! makes a tensor of a storage. Those are recognised by name; a pickle with anything else is refused.

use super::bytes::{array, u16_at, u32_at};
use super::zip::Archive;
use super::{MAX_DIMENSIONS, MAX_TENSORS, MAX_VALUES, Tensor};
use crate::learned::Error;
use std::collections::{BTreeMap, HashMap};

const FORMAT: &str = "PyTorch";
const MAX_PICKLE: usize = 1 << 22;

fn damaged(problem: impl Into<String>) -> Error {
    Error::Damaged { format: FORMAT, problem: problem.into() }
}

fn unsupported(what: impl Into<String>) -> Error {
    Error::Unsupported { format: FORMAT, what: what.into() }
}

/// The float tensors of the state dict in `archive`.
pub(super) fn state_dict(archive: &Archive<'_>) -> Result<BTreeMap<String, Tensor>, Error> {
    let (root, program) = archive.find("/data.pkl").ok_or_else(|| unsupported("no `data.pkl`"))?;
    if archive.get(&format!("{root}/byteorder")).is_some_and(|order| order != b"little") {
        return Err(unsupported("big-endian numbers"));
    }
    if program.len() > MAX_PICKLE {
        return Err(unsupported("a pickle of more than 4 MiB"));
    }
    let mut machine = Machine { program, ..Machine::default() };
    let Value::Object(top) = machine.run()? else { return Err(unsupported("no state dict")) };
    let Some(Object::Dict(entries)) = machine.objects.get(top) else {
        return Err(unsupported("no state dict"));
    };
    let (mut tensors, mut count, mut total) = (BTreeMap::new(), 0_usize, 0_usize);
    for (name, value) in entries {
        let (Value::Text(name), Value::Object(index)) = (name, value) else { continue };
        let Some(Object::Tensor(tensor)) = machine.objects.get(*index) else { continue };
        if !tensor.storage.is_float {
            continue;
        }
        let content = archive
            .get(&format!("{root}/data/{}", tensor.storage.key))
            .ok_or_else(|| damaged(format!("the values of tensor `{name}` are missing")))?;
        let loaded =
            tensor.load(content).ok_or_else(|| damaged(format!("tensor `{name}` exceeds its values")))?;
        // Not the number of names: a hostile file repeats one of them.
        count += 1;
        total += loaded.values.len();
        if count > MAX_TENSORS || total > MAX_VALUES {
            return Err(unsupported("more tensors than any network known here"));
        }
        tensors.insert((*name).to_owned(), loaded);
    }
    Ok(tensors)
}

/// A value on the stack; compound ones live in [`Machine::objects`].
#[derive(Clone, Copy)]
enum Value<'a> {
    Mark,
    /// None, a truth value or a float: nothing that matters here.
    Other,
    Int(i64),
    Text(&'a str),
    Object(usize),
}

enum Object<'a> {
    Tuple(Vec<Value<'a>>),
    List,
    Dict(Vec<(Value<'a>, Value<'a>)>),
    Function(&'a str, &'a str),
    Storage(Storage<'a>),
    Tensor(View<'a>),
}

#[derive(Clone, Copy)]
struct Storage<'a> {
    is_float: bool,
    key: &'a str,
}

/// A tensor: a view of a storage.
struct View<'a> {
    storage: Storage<'a>,
    offset: usize,
    shape: Vec<usize>,
    strides: Vec<usize>,
}

impl View<'_> {
    fn load(&self, content: &[u8]) -> Option<Tensor> {
        let count = self.shape.iter().try_fold(1_usize, |n, d| n.checked_mul(*d))?;
        // A view may repeat values through strides of 0: no larger than what is stored, all the same.
        if count > content.len() / 4 {
            return None;
        }
        if count == 0 {
            // Beside a length of 0 the others may be anything.
            return Some(Tensor { shape: self.shape.clone(), values: Vec::new() });
        }
        let mut at = vec![self.offset];
        for (&length, &stride) in self.shape.iter().zip(&self.strides) {
            let mut next = Vec::with_capacity(at.len().checked_mul(length)?);
            for &start in &at {
                for i in 0..length {
                    next.push(start.checked_add(i.checked_mul(stride)?)?);
                }
            }
            at = next;
        }
        let (stored, _) = content.as_chunks::<4>();
        let value = |i: usize| stored.get(i).map(|b| f32::from_le_bytes(*b));
        let values = at.into_iter().map(value).collect::<Option<Vec<f32>>>()?;
        Some(Tensor { shape: self.shape.clone(), values })
    }
}

#[derive(Default)]
struct Machine<'a> {
    program: &'a [u8],
    at: usize,
    stack: Vec<Value<'a>>,
    memo: HashMap<usize, Value<'a>>,
    objects: Vec<Object<'a>>,
}

impl<'a> Machine<'a> {
    /// Interprets the program up to its end and gives the value it leaves.
    fn run(&mut self) -> Result<Value<'a>, Error> {
        let ended = || damaged("its pickle ends early");
        let malformed = || damaged("its pickle is malformed");
        loop {
            let opcode = *self.program.get(self.at).ok_or_else(ended)?;
            self.at += 1;
            match opcode {
                b'.' => return self.stack.pop().ok_or_else(malformed),
                // REDUCE and BINPERSID: the two that would run code.
                b'R' => self.reduce()?,
                b'Q' => self.storage()?,
                _ => match self.step(opcode) {
                    Some(true) => {}
                    Some(false) => {
                        return Err(unsupported(format!("pickle instruction {:#04x}", opcode)));
                    }
                    None => return Err(malformed()),
                },
            }
        }
    }

    /// One of the harmless instructions; `Some(false)` if it is none of them, `None` if the program is malformed.
    fn step(&mut self, opcode: u8) -> Option<bool> {
        match opcode {
            0x80 => self.at += 1, // PROTO
            b'(' => self.stack.push(Value::Mark),
            b'N' | 0x88 | 0x89 => self.stack.push(Value::Other), // None, True, False
            b'G' => {
                self.take(8)?; // BINFLOAT
                self.stack.push(Value::Other);
            }
            b'K' => {
                let value = i64::from(self.byte()?);
                self.stack.push(Value::Int(value));
            }
            b'M' => {
                let value = u16_at(self.take(2)?, 0)? as i64;
                self.stack.push(Value::Int(value));
            }
            b'J' => {
                let value = i32::from_le_bytes(array(self.take(4)?, 0)?);
                self.stack.push(Value::Int(i64::from(value)));
            }
            // LONG1, up to eight bytes in two's complement.
            0x8a => {
                let length = usize::from(self.byte()?);
                let digits = self.take(length)?;
                let mut wide = [if digits.last().is_some_and(|d| d & 0x80 != 0) { 0xff } else { 0 }; 8];
                wide.get_mut(..length)?.copy_from_slice(digits);
                self.stack.push(Value::Int(i64::from_le_bytes(wide)));
            }
            b'X' => {
                let length = u32_at(self.take(4)?, 0)?;
                let text = std::str::from_utf8(self.take(length)?).ok()?;
                self.stack.push(Value::Text(text));
            }
            // GLOBAL: two lines, module and name.
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push(Object::Function(module, name));
            }
            b'q' | b'r' => {
                let slot = self.slot(opcode == b'q')?;
                self.memo.insert(slot, *self.stack.last()?);
            }
            b'h' | b'j' => {
                let slot = self.slot(opcode == b'h')?;
                self.stack.push(*self.memo.get(&slot)?);
            }
            b')' => self.push(Object::Tuple(Vec::new())),
            b'}' => self.push(Object::Dict(Vec::new())),
            b']' => self.push(Object::List),
            b'a' => drop(self.stack.pop()?), // APPEND: no list matters
            b'e' => drop(self.pop_to_mark()?),
            b't' => {
                let items = self.pop_to_mark()?;
                self.push(Object::Tuple(items));
            }
            0x85..=0x87 => {
                let start = self.stack.len().checked_sub(usize::from(opcode - 0x84))?;
                let items = self.stack.split_off(start);
                self.push(Object::Tuple(items));
            }
            b's' => {
                let start = self.stack.len().checked_sub(2)?;
                let items = self.stack.split_off(start);
                self.set_items(&items)?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.set_items(&items)?;
            }
            b'b' => drop(self.stack.pop()?), // BUILD: attributes of the dict (`_metadata`)
            _ => return Some(false),
        }
        Some(true)
    }

    /// REDUCE: calls one of the known functions.
    fn reduce(&mut self) -> Result<(), Error> {
        let malformed = || damaged("its pickle is malformed");
        let (arguments, function) = (self.stack.pop(), self.stack.pop());
        let (Some(Value::Object(a)), Some(Value::Object(f))) = (arguments, function) else {
            return Err(malformed());
        };
        let (Some(Object::Tuple(arguments)), Some(Object::Function(module, name))) =
            (self.objects.get(a), self.objects.get(f))
        else {
            return Err(malformed());
        };
        let made = match (*module, *name) {
            ("collections", "OrderedDict") if arguments.is_empty() => Object::Dict(Vec::new()),
            ("torch._utils", "_rebuild_tensor_v2") => {
                Object::Tensor(self.view(arguments).ok_or_else(|| unsupported("an unusual tensor"))?)
            }
            ("torch._utils", "_rebuild_parameter") => match arguments.first() {
                Some(&tensor @ Value::Object(_)) => {
                    self.stack.push(tensor);
                    return Ok(());
                }
                _ => return Err(malformed()),
            },
            _ => return Err(unsupported(format!("a call of `{module}.{name}`"))),
        };
        self.push(made);
        Ok(())
    }

    /// The arguments `(storage, offset, shape, strides, ...)` of a tensor.
    fn view(&self, arguments: &[Value<'a>]) -> Option<View<'a>> {
        let &[Value::Object(storage), Value::Int(offset), Value::Object(shape), Value::Object(strides), ..] =
            arguments
        else {
            return None;
        };
        let numbers = |index: usize| -> Option<Vec<usize>> {
            let Object::Tuple(items) = self.objects.get(index)? else { return None };
            let number = |v: &Value<'_>| if let Value::Int(i) = v { usize::try_from(*i).ok() } else { None };
            items.iter().map(number).collect()
        };
        let Object::Storage(storage) = *self.objects.get(storage)? else { return None };
        let (shape, strides) = (numbers(shape)?, numbers(strides)?);
        let is_plain = shape.len() == strides.len() && shape.len() <= MAX_DIMENSIONS;
        is_plain.then_some(View { storage, offset: usize::try_from(offset).ok()?, shape, strides })
    }

    /// BINPERSID: `("storage", type, key, device, length)`.
    fn storage(&mut self) -> Result<(), Error> {
        let malformed = || damaged("its pickle is malformed");
        let Some(Value::Object(id)) = self.stack.pop() else { return Err(malformed()) };
        let Some(Object::Tuple(id)) = self.objects.get(id) else { return Err(malformed()) };
        let &[Value::Text("storage"), Value::Object(kind), Value::Text(key), ..] = id.as_slice() else {
            return Err(malformed());
        };
        let is_float = match self.objects.get(kind) {
            Some(Object::Function("torch", "FloatStorage")) => true,
            Some(Object::Function(
                "torch",
                "LongStorage" | "IntStorage" | "ShortStorage" | "CharStorage" | "ByteStorage" | "BoolStorage",
            )) => false,
            Some(Object::Function(_, name)) => return Err(unsupported(format!("numbers of type {name}"))),
            _ => return Err(malformed()),
        };
        self.push(Object::Storage(Storage { is_float, key }));
        Ok(())
    }

    fn push(&mut self, object: Object<'a>) {
        self.stack.push(Value::Object(self.objects.len()));
        self.objects.push(object);
    }

    fn set_items(&mut self, items: &[Value<'a>]) -> Option<()> {
        let Value::Object(index) = *self.stack.last()? else { return None };
        let Object::Dict(entries) = self.objects.get_mut(index)? else { return None };
        entries.extend(items.as_chunks::<2>().0.iter().map(|[key, value]| (*key, *value)));
        Some(())
    }

    fn pop_to_mark(&mut self) -> Option<Vec<Value<'a>>> {
        let mark = self.stack.iter().rposition(|v| matches!(v, Value::Mark))?;
        let items = self.stack.split_off(mark + 1);
        self.stack.pop();
        Some(items)
    }

    fn slot(&mut self, is_short: bool) -> Option<usize> {
        if is_short { self.byte().map(usize::from) } else { u32_at(self.take(4)?, 0) }
    }

    fn take(&mut self, length: usize) -> Option<&'a [u8]> {
        let taken = self.program.get(self.at..self.at.checked_add(length)?)?;
        self.at += length;
        Some(taken)
    }

    fn byte(&mut self) -> Option<u8> {
        self.take(1)?.first().copied()
    }

    fn line(&mut self) -> Option<&'a str> {
        let length = self.program.get(self.at..)?.iter().position(|&b| b == b'\n')?;
        let line = std::str::from_utf8(self.take(length)?).ok()?;
        self.at += 1;
        Some(line)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A zip archive of stored files, as PyTorch writes it.
    fn archive(files: &[(&str, &[u8])]) -> Vec<u8> {
        let (mut out, mut directory) = (Vec::new(), Vec::new());
        let short = |v: usize| (v as u16).to_le_bytes();
        let long = |v: usize| (v as u32).to_le_bytes();
        for (name, content) in files {
            let at = out.len();
            let common =
                [&[0; 12][..], &long(content.len()), &long(content.len()), &short(name.len())].concat();
            // The local header is padded to align the content.
            out.extend(
                [b"PK\x03\x04\0\0", &common[..], &short(5), name.as_bytes(), b"FB\x01\0Z", content].concat(),
            );
            let entry = [b"PK\x01\x02\0\0\0\0", &common[..], &[0; 12], &long(at), name.as_bytes()];
            directory.extend(entry.concat());
        }
        let (at, count) = (out.len(), short(files.len()));
        out.extend(&directory);
        out.extend(
            [b"PK\x05\x06\0\0\0\0", &count[..], &count, &long(directory.len()), &long(at), &[0; 2]].concat(),
        );
        out
    }

    fn text(value: &str) -> Vec<u8> {
        [b"X", &(value.len() as u32).to_le_bytes()[..], value.as_bytes()].concat()
    }

    /// `_rebuild_tensor_v2((type, key), offset, shape, strides)`.
    fn tensor(kind: &str, key: &str, offset: u8, shape: &[u8], strides: &[u8]) -> Vec<u8> {
        let tuple =
            |v: &[u8]| [b"(", &v.iter().flat_map(|d| [b'K', *d]).collect::<Vec<u8>>()[..], b"t"].concat();
        let mut out = b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec();
        out.extend(
            [text("storage"), format!("ctorch\n{kind}\n").into_bytes(), text(key), text("cpu")].concat(),
        );
        out.extend([b"K\x06tQK", &[offset][..], &tuple(shape), &tuple(strides)].concat());
        out.extend(b"\x89ccollections\nOrderedDict\n)RtR");
        out
    }

    /// A state dict of these entries, with an attribute as PyTorch adds it.
    fn pickle(entries: &[(&str, Vec<u8>)]) -> Vec<u8> {
        let mut out = b"\x80\x02ccollections\nOrderedDict\n)Rq\x00(".to_vec();
        for (name, value) in entries {
            out.extend([text(name), value.clone()].concat());
        }
        out.extend([b"u}", &text("_metadata")[..], b"h\x00sb."].concat());
        out
    }

    fn values() -> Vec<u8> {
        (0..6).flat_map(|v| (v as f32).to_le_bytes()).collect()
    }

    fn load(program: &[u8]) -> Result<BTreeMap<String, Tensor>, Error> {
        let bytes = archive(&[("m/data.pkl", program), ("m/byteorder", b"little"), ("m/data/7", &values())]);
        state_dict(&Archive::new(&bytes)?)
    }

    fn good() -> Vec<u8> {
        pickle(&[
            ("a.weight", good_tensor()),
            ("turned", tensor("FloatStorage", "7", 1, &[2, 2], &[1, 3])),
            ("count", tensor("LongStorage", "9", 0, &[], &[])),
        ])
    }

    fn good_tensor() -> Vec<u8> {
        tensor("FloatStorage", "7", 0, &[2, 3], &[3, 1])
    }

    #[test]
    fn a_state_dict_is_read() {
        let tensors = load(&good()).unwrap();
        assert_eq!(tensors.len(), 2, "the counter is left out");
        assert_eq!(
            tensors["a.weight"],
            Tensor { shape: vec![2, 3], values: vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0] }
        );
        assert_eq!(tensors["turned"], Tensor { shape: vec![2, 2], values: vec![1.0, 4.0, 2.0, 5.0] });
    }

    #[test]
    fn code_is_refused_and_named() {
        let mut attack = b"\x80\x02cposix\nsystem\n(".to_vec();
        attack.extend([&text("echo")[..], b"tR."].concat());
        let error = load(&attack).unwrap_err();
        assert!(error.to_string().contains("posix.system"), "{error}");
        // So are other instructions that make objects (INST, OBJ, NEWOBJ).
        for opcode in [b'i', b'o', 0x81] {
            assert!(matches!(load(&[0x80, 2, opcode, b'.']), Err(Error::Unsupported { .. })));
        }
    }

    #[test]
    fn tensors_that_do_not_fit_are_refused() {
        for (kind, key, offset, shape, strides) in [
            ("FloatStorage", "7", 1, &[2, 3], &[3, 1]),
            ("FloatStorage", "7", 0, &[2, 3], &[200, 1]),
            ("FloatStorage", "7", 0, &[255, 255], &[0, 0]),
            ("FloatStorage", "8", 0, &[2, 3], &[3, 1]),
        ] {
            let error = load(&pickle(&[("x", tensor(kind, key, offset, shape, strides))])).unwrap_err();
            assert!(matches!(error, Error::Damaged { .. }), "{error}");
        }
        // A length of 0 beside one that no memory holds: nothing, and no memory is taken.
        let mut huge = tensor("FloatStorage", "7", 0, &[1, 0], &[1, 1]);
        let at = huge.windows(5).position(|w| w == [b'(', b'K', 1, b'K', 0]).unwrap();
        huge.splice(at + 1..at + 3, [0x8a, 8, 0, 0, 0, 0, 0, 0, 0, 0x40]);
        assert_eq!(load(&pickle(&[("x", huge)])).unwrap()["x"].values, [0.0_f32; 0]);
        // One name, again and again: each would be loaded.
        let same: Vec<_> = (0..=MAX_TENSORS).map(|_| ("x", good_tensor())).collect();
        assert!(load(&pickle(&same)).unwrap_err().to_string().contains("more tensors"));
        let half = pickle(&[("x", tensor("HalfStorage", "7", 0, &[2], &[1]))]);
        assert!(load(&half).unwrap_err().to_string().contains("HalfStorage"));
        let program = good();
        for cut in 0..program.len() {
            assert!(load(&program[..cut]).is_err());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(500))]
        #[test]
        fn no_change_of_a_file_panics(at in 0..1000_usize, with in any::<u8>(), cut in any::<bool>()) {
            let mut bytes = archive(&[("m/data.pkl", &good()), ("m/data/7", &values())]);
            let at = at % bytes.len();
            bytes[at] = with;
            if cut {
                bytes.truncate(at);
            }
            let _ = Archive::new(&bytes).and_then(|a| state_dict(&a));
        }
    }
}
