//! Python pickles as plain data: dictionaries, numbers, strings and numpy arrays, of all protocols.
//!
//! No code is run, whatever the file says: classes and functions are names that are compared with the few that
//! numpy uses.

mod machine;

use std::borrow::Cow;

use machine::{Id, Node};

/// The annotation files have a few kilobytes.
const MAX_BYTES: usize = 4 << 20;

/// A pickle whose outermost object is a dictionary.
#[derive(Debug)]
pub(crate) struct Pickle<'a> {
    nodes: Vec<Node<'a>>,
    root: Id,
}

/// An object in a pickle.
#[derive(Clone, Copy)]
pub(crate) struct Value<'p> {
    pickle: &'p Pickle<'p>,
    id: Id,
}

/// Numbers with a shape, the last axis varying fastest; a number has no axes.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Array {
    pub(crate) shape: Vec<usize>,
    pub(crate) values: Vec<f64>,
}

impl<'a> Pickle<'a> {
    /// Parses a pickle.
    pub(crate) fn parse(bytes: &'a [u8]) -> Result<Self, String> {
        if bytes.len() > MAX_BYTES {
            return Err(format!("has {} bytes, too many for an annotation", bytes.len()));
        }
        let (nodes, root) = machine::run(bytes)?;
        let pickle = Self { nodes, root };
        match pickle.node(root) {
            Node::Dict(_) => Ok(pickle),
            _ => Err("isn't a dictionary".into()),
        }
    }

    /// The entry `key` of the dictionary.
    pub(crate) fn get<'p>(&'p self, key: &str) -> Option<Value<'p>>
    where
        'a: 'p,
    {
        let Node::Dict(entries) = self.node(self.root) else { return None };
        let id = entries.iter().rev().find(|(k, _)| self.is_text(*k, key))?.1;
        Some(Value { pickle: self, id })
    }

    fn node(&self, id: Id) -> &Node<'a> {
        self.nodes.get(id as usize).unwrap_or(&Node::Opaque)
    }

    fn tuple(&self, id: Id) -> &[Id] {
        match self.node(id) {
            Node::Tuple(items) | Node::List(items) => items,
            _ => &[],
        }
    }

    /// Name of the function of a call, its arguments and state.
    fn call(&self, id: Id) -> Option<(&str, &[Id], &[Id])> {
        let Node::Call { function, args, state } = self.node(id) else { return None };
        let Node::Global(name) = self.node(*function) else { return None };
        Some((name, self.tuple(*args), state.map_or(&[], |s| self.tuple(s))))
    }

    /// Whether it is this ASCII text. Makes no copy: hostile files have a million keys that are one long string.
    fn is_text(&self, id: Id, key: &str) -> bool {
        match self.node(id) {
            Node::Text(text) => text == key,
            Node::Bytes(bytes) => bytes.as_ref() == key.as_bytes(),
            // numpy.str_, and what Python 3 writes for Python 2.
            Node::Call { .. } => self.call(id).is_some_and(|(name, args, _)| {
                matches!(name, "encode" | "bytes" | "bytearray")
                    && args.first().is_some_and(|a| match self.node(*a) {
                        Node::Text(text) => text == key,
                        Node::Bytes(bytes) => bytes.as_ref() == key.as_bytes(),
                        _ => false,
                    })
            }),
            _ => false,
        }
    }

    fn text(&self, id: Id) -> Option<Cow<'_, str>> {
        match self.node(id) {
            Node::Text(text) => Some(Cow::Borrowed(text)),
            Node::Bytes(bytes) => Some(bytes.iter().map(|b| char::from(*b)).collect()),
            // numpy.str_
            Node::Call { .. } => self.bytes(id).map(|b| b.iter().map(|b| char::from(*b)).collect()),
            _ => None,
        }
    }

    /// Bytes, also where Python 3 writes them for Python 2: as text, encoded as Latin-1 by a call.
    fn bytes(&self, id: Id) -> Option<Cow<'_, [u8]>> {
        let latin1 =
            |text: &str| text.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect::<Option<Vec<u8>>>();
        match self.node(id) {
            Node::Bytes(bytes) => Some(Cow::Borrowed(bytes)),
            Node::Text(text) => latin1(text).map(Cow::Owned),
            _ => match self.call(id)? {
                ("encode" | "bytes" | "bytearray", args, _) => match args.first().map(|a| self.node(*a)) {
                    None => Some(Cow::Borrowed(&[])),
                    Some(Node::Text(text)) => latin1(text).map(Cow::Owned),
                    Some(Node::Bytes(bytes)) => Some(Cow::Borrowed(bytes)),
                    _ => None,
                },
                _ => None,
            },
        }
    }

    fn number(&self, id: Id) -> Option<f64> {
        match self.node(id) {
            Node::Bool(v) => Some(f64::from(u8::from(*v))),
            Node::Int(v) => Some(*v as f64),
            Node::Float(v) => Some(*v),
            Node::Call { .. } => match self.array(id).ok()?.values.as_slice() {
                [v] => Some(*v),
                _ => None,
            },
            _ => None,
        }
    }

    fn array(&self, id: Id) -> Result<Array, String> {
        if let Some((name, args, state)) = self.call(id) {
            return match (name, args, state) {
                ("_reconstruct", _, [.., shape, dtype, fortran, data]) => {
                    let fortran = matches!(self.node(*fortran), Node::Bool(true) | Node::Int(1));
                    self.dense(self.shape(*shape)?, *dtype, fortran, *data)
                }
                ("scalar", [dtype, data], _) => self.dense(Vec::new(), *dtype, false, *data),
                ("_frombuffer", [data, dtype, shape, order], _) => {
                    let fortran = self.text(*order).is_some_and(|o| o == "F");
                    self.dense(self.shape(*shape)?, *dtype, fortran, *data)
                }
                _ => Err("isn't a numpy array".into()),
            };
        }
        match self.node(id) {
            Node::Bool(_) | Node::Int(_) | Node::Float(_) => {
                Ok(Array { shape: Vec::new(), values: self.number(id).into_iter().collect() })
            }
            Node::List(items) | Node::Tuple(items) => {
                let values: Option<Vec<f64>> = items.iter().map(|i| self.plain_number(*i)).collect();
                let values = values.ok_or("isn't a list of numbers")?;
                Ok(Array { shape: vec![values.len()], values })
            }
            _ => Err("isn't a numpy array".into()),
        }
    }

    /// A number of Python or numpy; not through [`Self::array`] of a list, which would recurse.
    fn plain_number(&self, id: Id) -> Option<f64> {
        match self.node(id) {
            Node::List(_) | Node::Tuple(_) => None,
            _ => self.number(id),
        }
    }

    fn shape(&self, id: Id) -> Result<Vec<usize>, String> {
        let axes = self.tuple(id);
        let axis = |id: &Id| match self.node(*id) {
            Node::Int(n) => usize::try_from(*n).ok(),
            _ => None,
        };
        let shape: Option<Vec<usize>> = if axes.len() > 8 { None } else { axes.iter().map(axis).collect() };
        shape.ok_or_else(|| "has an unusable shape".to_owned())
    }

    fn dense(&self, shape: Vec<usize>, dtype: Id, fortran: bool, data: Id) -> Result<Array, String> {
        let (kind, size, big_endian) = self.dtype(dtype).ok_or("holds no numbers")?;
        // `None` and its like in an array of objects.
        let bytes = self.bytes(data).ok_or("holds no numbers")?;
        let count = shape.iter().try_fold(1_usize, |n, axis| n.checked_mul(*axis));
        if count.and_then(|n| n.checked_mul(size)) != Some(bytes.len()) {
            return Err(format!("has {} bytes, which isn't its shape {shape:?}", bytes.len()));
        }
        let number = |b: &[u8]| decode(kind, size, big_endian, b);
        let values: Option<Vec<f64>> = bytes.chunks_exact(size).map(number).collect();
        let mut values = values.ok_or("has numbers of an unknown type")?;
        if let (true, &[rows, columns]) = (fortran, shape.as_slice()) {
            let column_major = std::mem::take(&mut values);
            let at = |i: usize| column_major.get(i % columns * rows + i / columns).copied();
            values = (0..rows * columns).filter_map(at).collect();
        } else if fortran && shape.len() > 2 {
            return Err("is in column-major order with more than two axes".into());
        }
        Ok(Array { shape, values })
    }

    /// Kind, bytes and whether the byte order is big-endian.
    fn dtype(&self, id: Id) -> Option<(char, usize, bool)> {
        let ("dtype", args, state) = self.call(id)? else { return None };
        let code = self.text(*args.first()?)?;
        let order = state.get(1).and_then(|s| self.text(*s));
        let big = code.starts_with('>') || order.is_some_and(|o| o == ">");
        let code = code.trim_start_matches(['<', '>', '|', '=']);
        let mut chars = code.chars();
        let kind = chars.next()?;
        let size: usize = chars.as_str().parse().ok()?;
        (size > 0).then_some((kind, size, big))
    }
}

impl Value<'_> {
    /// Whether it is `None`, also inside an array of objects without axes.
    pub(crate) fn is_none(self) -> bool {
        if let Some(("_reconstruct", _, [.., data])) = self.pickle.call(self.id)
            && let [item] = self.pickle.tuple(*data)
        {
            return matches!(self.pickle.node(*item), Node::Nothing);
        }
        matches!(self.pickle.node(self.id), Node::Nothing)
    }

    /// A string; bytes count as Latin-1.
    pub(crate) fn text(self) -> Option<String> {
        self.pickle.text(self.id).map(Cow::into_owned)
    }

    /// A numpy array, a number of Python or numpy, or a list of such numbers.
    pub(crate) fn array(self) -> Result<Array, String> {
        self.pickle.array(self.id)
    }

    /// Exactly `N` numbers, whatever their shape.
    pub(crate) fn numbers<const N: usize>(self) -> Result<[f64; N], String> {
        let array = self.array()?;
        let n = array.values.len();
        let values: [f64; N] =
            array.values.try_into().map_err(|_| format!("holds {n} numbers instead of {N}"))?;
        if values.iter().all(|v| v.is_finite()) {
            Ok(values)
        } else {
            Err("holds a number that isn't finite".into())
        }
    }
}

/// A number of `size` bytes; kinds are numpy's `f`, `i`, `u`, `b`.
pub(super) fn decode(kind: char, size: usize, big_endian: bool, bytes: &[u8]) -> Option<f64> {
    if size > 8 {
        return None;
    }
    let mut word = [0_u8; 8];
    for (i, slot) in word.iter_mut().take(size).enumerate() {
        *slot = *bytes.get(if big_endian { size - 1 - i } else { i })?;
    }
    let bits = u64::from_le_bytes(word);
    let signed = (bits << (64 - 8 * size)) as i64 >> (64 - 8 * size);
    match (kind, size) {
        ('f', 8) => Some(f64::from_bits(bits)),
        ('f', 4) => Some(f64::from(f32::from_bits(bits as u32))),
        ('i', _) => Some(signed as f64),
        ('u' | 'b', _) => Some(bits as f64),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
