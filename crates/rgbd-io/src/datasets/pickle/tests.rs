use super::*;
use proptest::prelude::*;

/// Every protocol of Python 2 and 3, written by `tests/data/write_pickles.py`.
const GOLDEN: [(&str, &[u8]); 9] = [
    ("py2, 0", include_bytes!("../../../tests/data/py2_protocol0.pkl")),
    ("py2, 1", include_bytes!("../../../tests/data/py2_protocol1.pkl")),
    ("py2, 2", include_bytes!("../../../tests/data/py2_protocol2.pkl")),
    ("py3, 0", include_bytes!("../../../tests/data/py3_protocol0.pkl")),
    ("py3, 1", include_bytes!("../../../tests/data/py3_protocol1.pkl")),
    ("py3, 2", include_bytes!("../../../tests/data/py3_protocol2.pkl")),
    ("py3, 3", include_bytes!("../../../tests/data/py3_protocol3.pkl")),
    ("py3, 4", include_bytes!("../../../tests/data/py3_protocol4.pkl")),
    ("py3, 5", include_bytes!("../../../tests/data/py3_protocol5.pkl")),
];

#[test]
fn reads_what_python_writes() {
    for (name, bytes) in GOLDEN {
        let pickle = Pickle::parse(bytes).unwrap();
        let array =
            |key: &str| pickle.get(key).unwrap().array().unwrap_or_else(|e| panic!("{name}: {key} {e}"));
        let expect = |key: &str, shape: &[usize], values: &[f64]| {
            assert_eq!(array(key), Array { shape: shape.to_vec(), values: values.to_vec() }, "{name}: {key}");
        };
        expect("camMat", &[3, 3], &[614.627, 0.0, 320.262, 0.0, 614.101, 238.469, 0.0, 0.0, 1.0]);
        expect("objRot", &[3, 1], &[0.5, -1.25, 2.0]);
        expect("objTrans", &[3], &[0.0625, -0.03125, -0.5]);
        expect("objLabel", &[], &[12.0]);
        expect("fortran", &[2, 3], &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        expect("big", &[2], &[1.5, -2.5]);
        expect("flags", &[2], &[1.0, 0.0]);
        expect("scalar", &[], &[0.1]);
        expect("empty", &[0, 3], &[]);
        expect("list", &[3], &[1.0, 2.5, -3.0]);
        assert_eq!(pickle.get("objName").unwrap().text().unwrap(), "019_pitcher_base", "{name}");
        let bytes: Vec<u32> = pickle.get("bytes").unwrap().text().unwrap().chars().map(u32::from).collect();
        assert_eq!(bytes, [0, 10, 39, 92, 255], "{name}");
        assert!(
            pickle.get("nothing").unwrap().is_none() && pickle.get("objects").unwrap().is_none(),
            "{name}"
        );
        assert!(!pickle.get("camMat").unwrap().is_none() && pickle.get("missing").is_none(), "{name}");
        assert!(pickle.get("objects").unwrap().array().is_err() && pickle.get("ordered").is_some(), "{name}");
        assert!(pickle.get("camMat").unwrap().numbers::<3>().unwrap_err().contains("9 numbers"), "{name}");
    }
}

#[test]
fn hostile_pickles_end_in_an_error_or_in_data() {
    // Doubling by reference: 2^40 items if anything copied them.
    let mut laughs = b"\x80\x02]q\x00".to_vec();
    for i in 0..40_u8 {
        laughs.extend([b']', b'q', i + 1, b'(', b'h', i, b'h', i, b'e']);
    }
    // {"x": that}.
    let mut dict = b"\x80\x02}U\x01x".to_vec();
    dict.extend(&laughs[2..]);
    dict.extend([b'0'; 41]);
    dict.extend(b"h\x28s.");
    let pickle = Pickle::parse(&dict).unwrap();
    assert!(pickle.get("x").unwrap().array().is_err());
    // Nesting as deep as the file is long, and a list that holds itself.
    let mut deep = b"\x80\x02}U\x01x".to_vec();
    deep.extend(std::iter::repeat_n(b']', 1 << 20));
    deep.extend(std::iter::repeat_n(b'a', (1 << 20) - 1));
    deep.extend(b"s.");
    assert!(Pickle::parse(&deep).unwrap().get("x").unwrap().array().is_err());
    let own = Pickle::parse(b"\x80\x02}U\x01x]q\x00h\x00as.").unwrap();
    assert!(own.get("x").unwrap().array().is_err());
    // Half a million keys that all are one string of a megabyte, and none of them what is asked for.
    let mut keys = b"\x80\x02}(T\x00\x00\x10\x00".to_vec();
    keys.extend(vec![b'k'; 1 << 20]);
    keys.extend(b"q\x00N");
    keys.extend(b"h\x00N".repeat(1 << 19));
    keys.extend(b"u.");
    let pickle = Pickle::parse(&keys).unwrap();
    assert!(pickle.get("x").is_none() && pickle.get("camMat").is_none());
    // A call of os.system is a name and nothing else.
    let call = Pickle::parse(b"}U\x01xcos\nsystem\n(U\x04truetRs.").unwrap();
    assert!(call.get("x").unwrap().array().is_err());
    // Lengths beyond the file.
    for bytes in [
        &b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\xff."[..],
        b"T\xff\xff\xff\x7f.",
        b"",
        b".",
        b"(",
        b"h\x07.",
    ] {
        assert!(Pickle::parse(bytes).is_err());
    }
    assert!(Pickle::parse(&vec![b'N'; MAX_BYTES + 1]).is_err());
}

/// Looks at everything; only panics could fail.
fn look(bytes: &[u8]) {
    let Ok(pickle) = Pickle::parse(bytes) else { return };
    for key in ["camMat", "objRot", "objTrans", "objName", "fortran", "objects", "list", "bytes", "scalar"] {
        if let Some(value) = pickle.get(key) {
            let _ = (value.array(), value.text(), value.is_none(), value.numbers::<3>());
        }
    }
}

#[test]
fn every_truncation_is_survived() {
    for (_, bytes) in GOLDEN {
        (0..bytes.len()).for_each(|n| assert!(Pickle::parse(&bytes[..n]).is_err()));
    }
}

proptest! {
    #[test]
    fn mutations_are_survived(
        which in 0usize..GOLDEN.len(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut bytes = GOLDEN[which].1.to_vec();
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        look(&bytes);
    }

    #[test]
    fn noise_is_survived(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        look(&bytes);
    }
}
