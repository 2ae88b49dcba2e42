//! Rust source without what is not code.

/// The source with comments, strings and character literals replaced by spaces; line breaks stay.
pub(super) fn without_text(source: &str) -> String {
    let bytes = source.as_bytes();
    let mut out = String::with_capacity(source.len());
    let mut i = 0;
    while i < bytes.len() {
        let end = match skipped(bytes, i) {
            Some(end) => end.min(bytes.len()),
            None => {
                out.push(if bytes[i].is_ascii() { bytes[i] as char } else { ' ' });
                i += 1;
                continue;
            }
        };
        out.extend(bytes[i..end].iter().map(|b| if *b == b'\n' { '\n' } else { ' ' }));
        i = end;
    }
    out
}

/// The part before the first `#[cfg(test)]` module, of source that went through [`without_text`].
pub(super) fn without_tests(code: &str) -> &str {
    let mut rest = 0;
    while let Some(at) = code[rest..].find("#[cfg(test)]") {
        let start = rest + at;
        rest = start + "#[cfg(test)]".len();
        if code[rest..].trim_start().starts_with("mod ") {
            return &code[..start];
        }
    }
    code
}

/// Whether `word` occurs in the code as a whole path or identifier.
pub(super) fn has_word(code: &str, word: &str) -> bool {
    let is_part = |c: char| c.is_alphanumeric() || c == '_';
    code.match_indices(word)
        .any(|(at, _)| !code[..at].ends_with(is_part) && !code[at + word.len()..].starts_with(is_part))
}

/// End of the comment or literal that starts at `i`, if one does.
fn skipped(bytes: &[u8], i: usize) -> Option<usize> {
    let rest = &bytes[i..];
    if rest.starts_with(b"//") {
        return Some(i + rest.iter().position(|b| *b == b'\n').unwrap_or(rest.len()));
    }
    if rest.starts_with(b"/*") {
        return Some(i + block_comment(rest));
    }
    let follows_word = i > 0 && (bytes[i - 1].is_ascii_alphanumeric() || bytes[i - 1] == b'_');
    match rest[0] {
        b'"' => Some(i + string(rest)),
        b'r' if !follows_word || bytes[i - 1] == b'b' => raw_string(rest).map(|n| i + n),
        // A quote is a character if it closes again after one; else it starts a lifetime.
        b'\'' => match rest {
            [_, b'\\', ..] => {
                Some(i + 3 + rest.get(3..)?.iter().position(|b| *b == b'\'').map_or(0, |n| n + 1))
            }
            _ => {
                let first = std::str::from_utf8(&rest[1..rest.len().min(5)])
                    .map_or_else(|e| e.valid_up_to(), str::len);
                let text = std::str::from_utf8(&rest[1..1 + first]).ok()?;
                let length = text.chars().next()?.len_utf8();
                (rest.get(1 + length) == Some(&b'\'')).then_some(i + length + 2)
            }
        },
        _ => None,
    }
}

fn block_comment(rest: &[u8]) -> usize {
    let (mut depth, mut i) = (0_usize, 0);
    while i < rest.len() {
        if rest[i..].starts_with(b"/*") {
            depth += 1;
            i += 2;
        } else if rest[i..].starts_with(b"*/") {
            depth -= 1;
            i += 2;
            if depth == 0 {
                return i;
            }
        } else {
            i += 1;
        }
    }
    i
}

fn string(rest: &[u8]) -> usize {
    let mut i = 1;
    while i < rest.len() {
        match rest[i] {
            b'\\' => i += 2,
            b'"' => return i + 1,
            _ => i += 1,
        }
    }
    rest.len()
}

/// Length of the raw string literal at the start, if there is one.
fn raw_string(rest: &[u8]) -> Option<usize> {
    let hashes = rest[1..].iter().take_while(|b| **b == b'#').count();
    if rest.get(1 + hashes) != Some(&b'"') {
        return None;
    }
    let closing: Vec<u8> = std::iter::once(b'"').chain(std::iter::repeat_n(b'#', hashes)).collect();
    let body = 2 + hashes;
    let end = rest[body..].windows(closing.len()).position(|w| w == closing);
    Some(end.map_or(rest.len(), |n| body + n + closing.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_blanked_and_code_stays() {
        for (source, words) in [
            ("let a = \"word\"; b", "let a = ; b"),
            ("a // word\nb", "a \nb"),
            ("a /* word /* word */ word */ b", "a b"),
            (r##"a(r#"word " word"#) b"##, "a() b"),
            (r#"a('"') "word" b('\'') c"#, "a() b() c"),
            ("fn f<'a>(x: &'a str) { 'é' }", "fn f<'a>(x: &'a str) { }"),
            (r#"a("\" word") b"#, "a() b"),
            ("a \"unclosed word", "a"),
        ] {
            let squeeze = |s: &str| s.split(' ').filter(|s| !s.is_empty()).collect::<String>();
            assert_eq!(squeeze(&without_text(source)), squeeze(words), "{source}");
        }
    }

    #[test]
    fn tests_are_cut_off() {
        assert_eq!(without_tests("a\n#[cfg(test)]\nmod tests { b }"), "a\n");
        assert_eq!(without_tests("#[cfg(test)]\nuse x;\nb"), "#[cfg(test)]\nuse x;\nb");
    }

    #[test]
    fn words_are_whole() {
        assert!(has_word("x = unsafe { y }", "unsafe"));
        assert!(!has_word("#![deny(unsafe_code)]", "unsafe"));
        assert!(has_word("std::fs::read()", "std::fs") && !has_word("std::fsync()", "std::fs"));
    }
}
