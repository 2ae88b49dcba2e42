#![no_main]

#[path = "../decoder.rs"]
mod decoder;

libfuzzer_sys::fuzz_target!(init: decoder::may_panic_if_caught(), |data: &[u8]| fuzz_targets::run("images", data));
