#![no_main]

libfuzzer_sys::fuzz_target!(
    // A model file is tried by this program, in a child process.
    init: if hardnessd_core::trial::entry().is_some() {
        std::process::exit(0)
    },
    |bytes: &[u8]| hardnessd_fuzz::model(bytes)
);
