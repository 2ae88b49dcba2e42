//! Pickles of protocol 2 as Python 3 writes them: a dictionary of numbers, strings and numpy arrays.

/// What a dictionary can hold.
pub(super) enum Value<'a> {
    Int(i32),
    Text(&'a str),
    /// `float64` of some shape, the last axis varying fastest.
    Array(&'a [usize], &'a [f64]),
}

/// The bytes of a pickled dictionary.
pub(super) fn dictionary(entries: &[(&str, Value<'_>)]) -> Vec<u8> {
    let mut out = b"\x80\x02}(".to_vec();
    for (key, value) in entries {
        text(&mut out, key);
        match value {
            Value::Int(v) => int(&mut out, *v),
            Value::Text(v) => text(&mut out, v),
            Value::Array(shape, values) => array(&mut out, shape, values),
        }
    }
    out.extend(b"u.");
    out
}

fn int(out: &mut Vec<u8>, value: i32) {
    out.push(b'J');
    out.extend(value.to_le_bytes());
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.push(b'X');
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

/// Protocol 2 has no bytes: they are a string, and a call that encodes it as Latin-1.
fn bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    out.extend(b"c_codecs\nencode\n");
    text(out, &bytes.iter().map(|b| char::from(*b)).collect::<String>());
    text(out, "latin1");
    out.extend(b"\x86R");
}

/// `_reconstruct(ndarray, (0,), b"b")` with the state `(1, shape, dtype, False, data)`.
fn array(out: &mut Vec<u8>, shape: &[usize], values: &[f64]) {
    out.extend(b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85");
    bytes(out, b"b");
    out.extend(b"\x87R(K\x01(");
    shape.iter().for_each(|axis| int(out, *axis as i32));
    // dtype("f8", False, True) with the state (3, "<", None, None, None, -1, -1, 0).
    out.extend(b"tcnumpy\ndtype\n");
    text(out, "f8");
    out.extend(b"\x89\x88\x87R(K\x03");
    text(out, "<");
    out.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89");
    bytes(out, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    out.extend(b"tb");
}
