//! Data sets from strangers: the inputs that the fuzzer kept.

#[test]
fn a_data_set_that_the_fuzzer_kept_is_read_or_refused() {
    let corpus = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fuzz/corpus/npz");
    let files = std::fs::read_dir(corpus).expect("a corpus of data sets");
    let mut tried = 0;
    for file in files {
        crate::property::npz(&std::fs::read(file.unwrap().path()).unwrap());
        tried += 1;
    }
    assert!(tried > 1, "{tried}");
}
