#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| hardnessd_fuzz::references(bytes));
