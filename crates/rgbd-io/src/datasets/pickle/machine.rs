//! The stack machine that a pickle is a program for, with everything left out that runs code.
//!
//! Objects become nodes of one list and refer to each other by number, so nothing here recurses or copies: memory
//! is a constant times the length of the input, whatever the input does with its memo.

use std::borrow::Cow;
use std::collections::HashMap;

/// Number of a node.
pub(super) type Id = u32;

/// One object.
#[derive(Debug)]
pub(super) enum Node<'a> {
    Nothing,
    Bool(bool),
    Int(i64),
    Float(f64),
    Bytes(Cow<'a, [u8]>),
    Text(Cow<'a, str>),
    List(Vec<Id>),
    Tuple(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// A class or function, by the last part of its name. It is only ever compared with names we know.
    Global(Cow<'a, str>),
    /// `function(*args)`, noted and not run; `state` is what Python would hand to `__setstate__`.
    Call {
        function: Id,
        args: Id,
        state: Option<Id>,
    },
    /// Something without a meaning for us.
    Opaque,
}

/// The nodes of a pickle and the one it stands for.
pub(super) fn run(bytes: &[u8]) -> Result<(Vec<Node<'_>>, Id), String> {
    let mut machine =
        Machine { rest: bytes, nodes: Vec::new(), stack: Vec::new(), marks: vec![], memo: HashMap::new() };
    while !machine.step()? {}
    let root = machine.pop()?;
    Ok((machine.nodes, root))
}

struct Machine<'a> {
    rest: &'a [u8],
    nodes: Vec<Node<'a>>,
    stack: Vec<Id>,
    /// Heights of the stack at its marks.
    marks: Vec<usize>,
    memo: HashMap<u64, Id>,
}

impl<'a> Machine<'a> {
    /// Runs one instruction; true at the end.
    fn step(&mut self) -> Result<bool, String> {
        match self.byte()? {
            b'.' => return Ok(true),
            // Protocol, frame.
            0x80 => drop(self.take(1)?),
            0x95 => drop(self.take(8)?),
            b'(' => self.marks.push(self.stack.len()),
            b'0' => drop(self.pop()?),
            b'1' => drop(self.pop_to_mark()?),
            b'2' => {
                let top = self.top()?;
                self.stack.push(top);
            }
            op @ (b'p' | b'q' | b'r' | 0x94) => {
                let key = match op {
                    b'p' => self.decimal()?,
                    b'q' => u64::from(self.byte()?),
                    b'r' => self.unsigned(4)?,
                    _ => self.memo.len() as u64,
                };
                let top = self.top()?;
                self.memo.insert(key, top);
            }
            op @ (b'g' | b'h' | b'j') => {
                let key = match op {
                    b'g' => self.decimal()?,
                    b'h' => u64::from(self.byte()?),
                    _ => self.unsigned(4)?,
                };
                let id = *self.memo.get(&key).ok_or("refers to an object that it doesn't hold")?;
                self.stack.push(id);
            }
            op @ (b'a' | b'e' | b's' | b'u' | 0x90 | b'b') => self.change(op)?,
            op @ (b'c' | 0x93 | b'R' | 0x81 | 0x92 | b'i' | b'o') => self.construct(op)?,
            op @ (b'l' | b'd' | b't' | b')' | b']' | b'}' | 0x85..=0x87 | 0x8f | 0x91) => {
                self.container(op)?
            }
            op => {
                let node = self.scalar(op)?;
                self.push(node)?;
            }
        }
        Ok(false)
    }

    /// Numbers and strings.
    fn scalar(&mut self, op: u8) -> Result<Node<'a>, String> {
        Ok(match op {
            b'N' => Node::Nothing,
            0x88 => Node::Bool(true),
            0x89 => Node::Bool(false),
            b'J' => Node::Int(i64::from(self.unsigned(4)? as u32 as i32)),
            b'K' => Node::Int(i64::from(self.byte()?)),
            b'M' => Node::Int(self.unsigned(2)? as i64),
            b'I' => match self.line()? {
                "00" => Node::Bool(false),
                "01" => Node::Bool(true),
                text => Node::Int(text.trim().parse().map_err(|_| "holds a damaged integer")?),
            },
            b'L' => self.line()?.trim_end_matches('L').parse().map_or(Node::Opaque, Node::Int),
            b'F' => Node::Float(self.line()?.trim().parse().map_err(|_| "holds a damaged number")?),
            b'G' => Node::Float(f64::from_bits(self.unsigned(8)?.swap_bytes())),
            op @ (0x8a | 0x8b) => {
                let length = if op == 0x8a { u64::from(self.byte()?) } else { self.unsigned(4)? };
                long(self.take_u64(length)?)
            }
            op @ (b'U' | b'C' | b'T' | b'B' | 0x8e | 0x96) => {
                let length = self.length(op)?;
                Node::Bytes(Cow::Borrowed(self.take_u64(length)?))
            }
            op @ (b'X' | 0x8c | 0x8d) => {
                let length = self.length(op)?;
                Node::Text(String::from_utf8_lossy(self.take_u64(length)?))
            }
            b'S' => Node::Bytes(Cow::Owned(unquote(self.line_bytes()?)?)),
            b'V' => Node::Text(Cow::Owned(unescape_unicode(self.line_bytes()?))),
            op => return Err(format!("uses the instruction 0x{op:02x}, which plain data doesn't need")),
        })
    }

    /// The length in front of a string.
    fn length(&mut self, op: u8) -> Result<u64, String> {
        match op {
            b'U' | b'C' | 0x8c => Ok(u64::from(self.byte()?)),
            b'T' | b'B' | b'X' => self.unsigned(4),
            _ => self.unsigned(8),
        }
    }

    /// New lists, tuples, sets (as lists) and dictionaries.
    fn container(&mut self, op: u8) -> Result<(), String> {
        let node = match op {
            b')' => Node::Tuple(Vec::new()),
            b']' | 0x8f => Node::List(Vec::new()),
            b'}' => Node::Dict(Vec::new()),
            0x85..=0x87 => {
                let mut items = vec![0; usize::from(op - 0x84)];
                for item in items.iter_mut().rev() {
                    *item = self.pop()?;
                }
                Node::Tuple(items)
            }
            b't' => Node::Tuple(self.pop_to_mark()?),
            b'd' => Node::Dict(pairs(&self.pop_to_mark()?)),
            _ => Node::List(self.pop_to_mark()?),
        };
        self.push(node)
    }

    /// Changes an object that exists.
    fn change(&mut self, op: u8) -> Result<(), String> {
        let items = match op {
            b'e' | b'u' | 0x90 => self.pop_to_mark()?,
            b's' => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
            _ => vec![self.pop()?],
        };
        let target = self.top()?;
        let Some(node) = self.nodes.get_mut(target as usize) else { return Err("is damaged".into()) };
        match (op, node) {
            (b'a' | b'e' | 0x90, Node::List(list)) => list.extend(items),
            (b's' | b'u', Node::Dict(dict)) => dict.extend(pairs(&items)),
            (b'b', Node::Call { state, .. }) => *state = items.first().copied(),
            // An object of a class that we don't know.
            (_, Node::Call { .. } | Node::Opaque | Node::Global(_)) => {}
            _ => return Err("adds items to something that has none".into()),
        }
        Ok(())
    }

    /// Classes, and the calls that would make objects of them.
    fn construct(&mut self, op: u8) -> Result<(), String> {
        let node = match op {
            b'c' => {
                self.line()?;
                Node::Global(Cow::Borrowed(self.line()?))
            }
            0x93 => {
                let name = self.pop()?;
                self.pop()?;
                match self.nodes.get(name as usize) {
                    // Borrowed from the input, so that this copies no text.
                    Some(Node::Text(Cow::Borrowed(name))) => Node::Global(Cow::Borrowed(*name)),
                    _ => Node::Opaque,
                }
            }
            b'i' => {
                self.line()?;
                self.line()?;
                self.pop_to_mark()?;
                Node::Opaque
            }
            b'o' => {
                self.pop_to_mark()?;
                Node::Opaque
            }
            op => {
                if op == 0x92 {
                    self.pop()?;
                }
                let args = self.pop()?;
                Node::Call { function: self.pop()?, args, state: None }
            }
        };
        // `collections.OrderedDict()` and its like are filled item by item.
        let node = match node {
            Node::Call { function, .. } if self.is_ordered_dict(function) => Node::Dict(Vec::new()),
            node => node,
        };
        self.push(node)
    }

    fn is_ordered_dict(&self, id: Id) -> bool {
        matches!(self.nodes.get(id as usize), Some(Node::Global(name)) if name == "OrderedDict")
    }

    fn push(&mut self, node: Node<'a>) -> Result<(), String> {
        let id = Id::try_from(self.nodes.len()).map_err(|_| "holds too many objects")?;
        self.nodes.push(node);
        self.stack.push(id);
        Ok(())
    }

    fn top(&self) -> Result<Id, String> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let above = self.stack.get(floor..).unwrap_or(&[]);
        above.last().copied().ok_or_else(|| "uses an object that isn't there".to_owned())
    }

    fn pop(&mut self) -> Result<Id, String> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    /// Everything above the last mark.
    fn pop_to_mark(&mut self) -> Result<Vec<Id>, String> {
        let mark = self.marks.pop().ok_or("closes a list that it didn't open")?;
        Ok(self.stack.split_off(mark.min(self.stack.len())))
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.rest.split_at_checked(length).ok_or("is truncated")?;
        self.rest = rest;
        Ok(taken)
    }

    fn take_u64(&mut self, length: u64) -> Result<&'a [u8], String> {
        self.take(usize::try_from(length).map_err(|_| "is truncated")?)
    }

    fn byte(&mut self) -> Result<u8, String> {
        self.take(1)?.first().copied().ok_or_else(|| "is truncated".to_owned())
    }

    /// A little-endian number of up to eight bytes.
    fn unsigned(&mut self, bytes: usize) -> Result<u64, String> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |n, b| n << 8 | u64::from(*b)))
    }

    fn line_bytes(&mut self) -> Result<&'a [u8], String> {
        let end = self.rest.iter().position(|b| *b == b'\n').ok_or("is truncated")?;
        let line = self.take(end)?;
        self.take(1)?;
        Ok(line.strip_suffix(b"\r").unwrap_or(line))
    }

    fn line(&mut self) -> Result<&'a str, String> {
        std::str::from_utf8(self.line_bytes()?).map_err(|_| "is damaged".to_owned())
    }

    fn decimal(&mut self) -> Result<u64, String> {
        self.line()?.trim().parse().map_err(|_| "holds a damaged number".to_owned())
    }
}

fn pairs(items: &[Id]) -> Vec<(Id, Id)> {
    items.as_chunks::<2>().0.iter().map(|[key, value]| (*key, *value)).collect()
}

/// A little-endian two's-complement integer.
fn long(bytes: &[u8]) -> Node<'static> {
    if bytes.len() > 8 {
        return Node::Opaque;
    }
    let negative = bytes.last().is_some_and(|b| *b >= 0x80);
    let start = if negative { -1_i64 } else { 0 };
    Node::Int(bytes.iter().rev().fold(start, |n, b| n << 8 | i64::from(*b)))
}

/// A Python string literal without its quotes and escapes.
fn unquote(line: &[u8]) -> Result<Vec<u8>, String> {
    let body = match line {
        [open @ (b'\'' | b'"'), body @ .., close] if open == close => body,
        _ => return Err("holds a string without quotes".into()),
    };
    let mut out = Vec::with_capacity(body.len());
    let mut bytes = body.iter().copied();
    while let Some(b) = bytes.next() {
        if b != b'\\' {
            out.push(b);
            continue;
        }
        match bytes.next() {
            Some(b'n') => out.push(b'\n'),
            Some(b'r') => out.push(b'\r'),
            Some(b't') => out.push(b'\t'),
            Some(b'x') => {
                let digit = |b: Option<u8>| b.and_then(|b| char::from(b).to_digit(16));
                match (digit(bytes.next()), digit(bytes.next())) {
                    (Some(high), Some(low)) => out.push((high * 16 + low) as u8),
                    _ => return Err("holds a damaged string".into()),
                }
            }
            Some(other) => out.push(other),
            None => return Err("holds a damaged string".into()),
        }
    }
    Ok(out)
}

/// Python's raw-unicode-escape: Latin-1, and `\uXXXX`.
fn unescape_unicode(line: &[u8]) -> String {
    let mut out = String::with_capacity(line.len());
    let mut at = 0;
    while let Some(&b) = line.get(at) {
        let digits = match (b, line.get(at + 1)) {
            (b'\\', Some(b'u')) => 4,
            (b'\\', Some(b'U')) => 8,
            _ => 0,
        };
        let code = line.get(at + 2..at + 2 + digits).filter(|_| digits > 0);
        let code = code.and_then(|hex| u32::from_str_radix(std::str::from_utf8(hex).ok()?, 16).ok());
        if let Some(c) = code.and_then(char::from_u32) {
            out.push(c);
            at += 2 + digits;
        } else {
            out.push(char::from(b));
            at += 1;
        }
    }
    out
}
