//! `hrn-train compare` and `report` on tiny data: the files that they write, and the runs that they
//! do not repeat.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime};

use hrn_train::data::dataset::Dataset;
use hrn_train::judge::paper;
use serde_json::Value;

use crate::{data, hrn_train, succeed, succeeded, trainer, write_data};

/// A comparison in its own directory.
struct Comparison {
    out: PathBuf,
    methods: &'static str,
    more: &'static [&'static str],
}

impl Comparison {
    fn new(name: &str, methods: &'static str, more: &'static [&'static str]) -> Self {
        let out = data().0.path().join(name);
        Self { out, methods, more }
    }

    fn command(&self) -> Command {
        self.command_of("2")
    }

    fn command_of(&self, seeds: &str) -> Command {
        let mut command = trainer(&["compare", "--profile", "smoke", "--seeds", seeds]);
        command.args(["--methods", self.methods]).args(self.more);
        command
            .arg("--data")
            .arg(&data().1)
            .arg("--out")
            .arg(&self.out);
        command
    }

    /// Runs the comparison to its end and returns its stderr.
    fn run(&self) -> String {
        let output = self.command().output().unwrap();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{errors}");
        // Stdout has the main table and the path of the page.
        let printed = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(printed.starts_with("method "), "{printed}");
        assert!(printed.ends_with("report.html\n"), "{printed}");
        errors
    }

    fn json(&self, name: &str) -> Vec<Value> {
        serde_json::from_slice(&std::fs::read(self.out.join(name)).unwrap()).unwrap()
    }

    fn text(&self, name: &str) -> String {
        std::fs::read_to_string(self.out.join(name)).unwrap()
    }

    /// When each run's model was written, by the run's name.
    fn models(&self) -> Vec<(String, SystemTime)> {
        let mut models = Vec::new();
        for entry in std::fs::read_dir(self.out.join("runs"))
            .into_iter()
            .flatten()
        {
            let entry = entry.unwrap();
            if let Ok(model) = entry.path().join("hrn.onnx").metadata() {
                let name = entry.file_name().to_string_lossy().into_owned();
                models.push((name, model.modified().unwrap()));
            }
        }
        models.sort();
        models
    }
}

/// A comparison that several tests share.
fn whole() -> &'static Comparison {
    static WHOLE: OnceLock<Comparison> = OnceLock::new();
    WHOLE.get_or_init(|| {
        let whole = Comparison::new("whole", "hrn100,features", &["--jobs", "2"]);
        whole.run();
        whole
    })
}

#[test]
fn the_counts_of_objects_add_up_to_the_accuracies() {
    let csv = whole().text("objects.csv");
    let mut lines = csv.lines();
    assert_eq!(
        lines.next(),
        Some("run,set,level,object,geometry,right,samples")
    );
    let mut sums = std::collections::BTreeMap::<(String, String), [f64; 2]>::new();
    let mut geometries = std::collections::BTreeMap::<String, u32>::new();
    for line in lines {
        let fields: Vec<&str> = line.split(',').collect();
        let [run, set, _, _, geometry, right, samples] = fields[..] else {
            panic!("{line}");
        };
        let sum = sums.entry((run.to_owned(), set.to_owned())).or_default();
        sum[0] += right.parse::<f64>().unwrap();
        sum[1] += samples.parse::<f64>().unwrap();
        *geometries.entry(set.to_owned()).or_default() += u32::from(!geometry.is_empty());
    }
    let results = whole().json("results.json");
    for result in &results {
        for set in ["paper_split", "fresh", "matched"] {
            let run = result["run"].as_str().unwrap().to_owned();
            let [right, samples] = sums[&(run, set.to_owned())];
            assert_eq!(result[set]["accuracy"], right / samples, "{set}");
        }
    }
    // Only the sets that are not of the paper's shapes have geometries.
    assert_eq!(geometries["fresh"], 0);
    assert_eq!(geometries["matched"], 80 * results.len() as u32);
}

#[test]
fn results_have_the_documented_fields_and_agree_with_evaluate() {
    let results = whole().json("results.json");
    let rows: Vec<(&str, u64, u64)> = results
        .iter()
        .map(|result| {
            let number = |key: &str| result[key].as_u64().unwrap();
            (
                result["method"].as_str().unwrap(),
                number("labels"),
                number("seed"),
            )
        })
        .collect();
    let expected = [
        ("hrn100", 160, 1),
        ("hrn100", 160, 2),
        ("features", 160, 1),
        ("features", 160, 2),
        ("features", 24, 1),
        ("features", 24, 2),
    ];
    assert_eq!(rows, expected);
    for result in &results {
        assert_eq!(result["profile"], "smoke");
        assert!(result["steps"].as_u64().unwrap() > 0, "{result}");
        assert!(result["seconds"].as_f64().is_some(), "{result}");
        // There are 20 fresh objects a material, with one press each in this profile.
        for (set, samples) in [("paper_split", 40), ("fresh", 80), ("matched", 80)] {
            assert_eq!(result[set]["n"], samples, "{set}");
            // The test split has one object a level, too few for an interval.
            let ends = (set != "paper_split").then_some(2);
            let interval = result[set]["accuracy_interval_by_object"].as_array();
            assert_eq!(interval.map(Vec::len), ends, "{set}");
        }
    }
    let model = whole().out.join("runs/hrn100-1/hrn.onnx");
    let evaluated = succeed(&[
        "evaluate",
        "--json",
        "--model",
        model.to_str().unwrap(),
        "--data",
        data().1.to_str().unwrap(),
    ]);
    let mut evaluated: Value = serde_json::from_str(&evaluated).unwrap();
    // `evaluate` also has what does not concern the levels.
    for more in ["beyond_neighbour", "shore", "sets"] {
        assert!(evaluated.as_object_mut().unwrap().remove(more).is_some());
    }
    assert_eq!(evaluated, results[0]["paper_split"]);
}

#[test]
fn tables_stand_beside_the_papers() {
    let tables = whole().text("tables.md");
    let hrn100 = paper::row("hrn100").unwrap();
    let line = |heading: &str, start: &str| {
        let section = tables
            .split("\n## ")
            .find(|part| part.starts_with(heading))
            .unwrap();
        let line = section.lines().find(|line| line.starts_with(start));
        line.unwrap_or_else(|| panic!("no {start} in {section}"))
            .to_owned()
    };
    let accuracies = line("Table 2", "| hrn100 |");
    for percent in hrn100.category_accuracy_percent {
        assert!(
            accuracies.contains(&format!("({percent:.1})")),
            "{accuracies}"
        );
    }
    assert!(accuracies.contains("(95.9)"), "{accuracies}");
    assert!(line("Table 3: kappa", "| hrn100 |").contains("(0.9453)"));
    let confusion = line("Table 3: confusion", "| hrn100 |");
    assert!(confusion.ends_with("| 244 | 5 | 1 | 0 |"), "{confusion}");
    assert!(tables.contains("| features, 24 labels |"), "{tables}");
}

#[test]
fn a_finished_comparison_does_nothing_again() {
    let comparison = Comparison::new("twice", "features,features", &["--swaps"]);
    let first = comparison.run();
    assert!(first.contains("features-1: done"), "{first}");
    assert!(first.contains("features-24-swapped-13-2: done"), "{first}");
    let (models, results) = (comparison.models(), comparison.text("results.json"));
    // There are two seeds. In this profile, there are also 4 assignments of the materials' roles.
    // Each is run with many labels and with few.
    assert_eq!(models.len(), 2 * 2 * (1 + 4));
    // A method that is named twice counts once.
    assert_eq!(comparison.json("results.json").len(), 2 * 2);
    let swaps = comparison.json("swaps.json");
    assert_eq!(swaps.len(), 2 * 2 * 4);
    let table = comparison.text("tables.md");
    assert!(table.contains("| features | 24 | 2 | 4 |"), "{table}");
    assert!(swaps.iter().all(|swap| swap["test"]["n"] == 4 * 20 * 10));
    let again = comparison.run();
    assert!(!again.contains("done"), "{again}");
    assert!(comparison.models() == models, "a run was done again");
    assert_eq!(comparison.text("results.json"), results);

    // Add runs of another method that are as good as finished.
    for run in ["1", "swapped-13-1"] {
        let from = comparison.out.join(format!("runs/features-24-{run}"));
        let to = comparison.out.join(format!("runs/ours-{run}"));
        std::fs::create_dir(&to).unwrap();
        for name in ["hrn.onnx", "evaluation.json", "metrics.csv"] {
            std::fs::copy(from.join(name), to.join(name)).unwrap();
        }
        let settings_text = std::fs::read_to_string(from.join("settings.toml")).unwrap();
        let settings_text = settings_text.replacen("features", "ours", 1);
        std::fs::write(to.join("settings.toml"), settings_text).unwrap();
    }
    // A comparison with fewer rows keeps the earlier results.
    let less = comparison.command_of("1").output().unwrap();
    assert!(less.status.success(), "{less:?}");
    let all = comparison.json("results.json");
    assert_eq!(
        all[..4],
        serde_json::from_str::<Vec<Value>>(&results).unwrap()
    );
    assert_eq!((all.len(), &all[4]["run"]), (5, &Value::from("ours-1")));
    let all = comparison.json("swaps.json");
    assert_eq!((all.len(), &all[16]["method"]), (17, &Value::from("ours")));

    // A run with other settings does not belong to the comparison.
    let settings_text = comparison.text("runs/features-1/settings.toml");
    for (from, to, expected) in [
        ("seed = 1\n", "seed = 2\n", "`seed`: found 2, expected 1"),
        ("features", "hrn100", "`method`: found \"hrn100\", expected"),
        (
            "labels = 160",
            "labels = 24",
            "`labels`: found 24, expected 160",
        ),
        (
            "\"object\"",
            "\"random\"",
            "`label_choice`: found \"random\"",
        ),
        (
            "full_scale_n = 10.2",
            "full_scale_n = 9.0",
            "`settings.full_scale_n`: found 9.0, expected 10.2",
        ),
    ] {
        let path = comparison.out.join("runs/features-1/settings.toml");
        std::fs::write(path, settings_text.replacen(from, to, 1)).unwrap();
        let output = comparison.command().output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(error.contains(expected), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    }
    std::fs::write(
        comparison.out.join("runs/features-1/settings.toml"),
        settings_text,
    )
    .unwrap();

    // Even if that row is not asked for, such a run is left out.
    let settings = comparison.out.join("runs/features-2/settings.toml");
    let settings_text = comparison.text("runs/features-2/settings.toml");
    std::fs::write(&settings, settings_text.replacen("10.2", "9.0", 1)).unwrap();
    let output = comparison.command_of("1").output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{error}");
    let message = "runs/features-2: not requested, and left out of the tables; \
                `settings.full_scale_n`: found 9.0, expected 10.2";
    assert!(error.contains(message), "{error}");
    assert_eq!(comparison.json("results.json").len(), 4);
}

#[test]
fn a_run_without_its_model_counts_by_its_results() {
    let comparison = Comparison::new("models-removed", "features", &[]);
    comparison.run();
    let results = comparison.text("results.json");
    let of_run = |file: &str| comparison.out.join("runs/features-2").join(file);
    for entry in std::fs::read_dir(of_run("")).unwrap() {
        let path = entry.unwrap().path();
        let kept = ["settings.toml", "revision", "metrics.csv", "compared.json"];
        if !kept.iter().any(|kept| path.ends_with(kept)) {
            if path.is_dir() {
                std::fs::remove_dir_all(path).unwrap();
            } else {
                std::fs::remove_file(path).unwrap();
            }
        }
    }
    let message = comparison.run();
    assert!(!message.contains("done"), "{message}");
    assert_eq!(comparison.text("results.json"), results);

    // If a test set is not among its results, its model is needed.
    let mut kept: Value =
        serde_json::from_str(&comparison.text("runs/features-2/compared.json")).unwrap();
    kept["sets"].as_object_mut().unwrap().remove("raw").unwrap();
    std::fs::write(of_run("compared.json"), kept.to_string()).unwrap();
    let output = comparison.command().output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success(), "{error}");
    assert!(
        error.contains("features-2/hrn.onnx: needed, because"),
        "{error}"
    );

    // A run that is removed altogether is run again.
    std::fs::remove_dir_all(of_run("")).unwrap();
    let message = comparison.run();
    assert!(message.contains("features-2: done"), "{message}");
}

#[test]
fn a_plan_runs_in_any_shell_and_the_comparison_finds_what_it_made() {
    let comparison = Comparison::new(
        "planned",
        "features,hrn15,nihrn,ours",
        &["--labels", "8", "--plan"],
    );
    let planned = comparison.command_of("1").output().unwrap();
    assert!(planned.status.success(), "{planned:?}");
    let lines = String::from_utf8(planned.stdout).unwrap();
    assert!(!comparison.out.join("results.json").exists());
    // `nihrn` takes stages of `ours`, so it comes after it. `features` and `hrn15` have three rows
    // each.
    let first = lines.lines().next().unwrap();
    assert!(
        first.contains("--method ours") && first.contains("&& "),
        "{first}"
    );
    assert!(
        first.contains("--method nihrn") && first.contains("--from"),
        "{first}"
    );
    assert_eq!(lines.matches("-8-1 --seed").count(), 4, "{lines}");

    // Let another program run the cheap lines, two at a time.
    let cheap: Vec<&str> = lines
        .lines()
        .filter(|line| line.contains("--method features"))
        .collect();
    assert_eq!(cheap.len(), 3, "{lines}");
    let folder = Path::new(env!("CARGO_BIN_EXE_hrn-train")).parent().unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let mut parallel = Command::new("xargs")
        .args(["-d", "\\n", "-P", "2", "-I", "{}", "sh", "-c", "{}"])
        .env("PATH", path)
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    let stdin = parallel.stdin.take().unwrap();
    std::io::Write::write_all(&mut &stdin, cheap.join("\n").as_bytes()).unwrap();
    drop(stdin);
    assert!(parallel.wait().unwrap().success());

    let merged = Comparison::new("planned", "features", &["--labels", "8"]);
    let message = merged.command_of("1").output().unwrap();
    assert!(message.status.success(), "{message:?}");
    let message = String::from_utf8(message.stderr).unwrap();
    assert!(!message.contains("done"), "a run was done again: {message}");
    let labels: Vec<Value> = merged
        .json("results.json")
        .iter()
        .map(|run| run["labels"].clone())
        .collect();
    assert_eq!(labels, [160, 24, 8]);
    // A row of extra labels that is not asked for stays.
    let less = Comparison::new("planned", "features", &[])
        .command_of("1")
        .output()
        .unwrap();
    assert!(less.status.success(), "{less:?}");
    assert_eq!(merged.json("results.json").len(), 3);
}

#[test]
fn a_plan_has_the_runs_with_swapped_materials() {
    let comparison = Comparison::new("planned-swaps", "features", &["--swaps", "--plan"]);
    let planned = comparison.command().output().unwrap();
    assert!(planned.status.success(), "{planned:?}");
    let lines = String::from_utf8(planned.stdout).unwrap();
    // Two numbers of labels, two seeds, four assignments. The one without a swap shares its
    // training with the comparison's own run, so it follows on the same line.
    assert_eq!(lines.lines().count(), 2 * 2 * 4, "{lines}");
    assert_eq!(lines.matches("-swapped-none-").count(), 2 * 2, "{lines}");
    for line in lines.lines().filter(|line| line.contains("-swapped-none-")) {
        assert!(line.contains(" && ") && line.contains("--from"), "{line}");
    }
}

#[test]
fn data_that_will_not_do_is_refused_before_anything_is_made() {
    let path = |name: &str| data().0.path().join(name);
    let samples = Dataset::read(&data().1).unwrap().samples;
    let write = |name: &str, meta: Value| {
        write_data(&path(name), &samples, &meta);
    };
    write("unsaid.npz", serde_json::json!({}));
    // This is a seed of the fresh test objects.
    write("fresh.npz", serde_json::json!({"seed": 2_019_002}));
    std::fs::write(path("text.npz"), "neither").unwrap();
    for (name, more, code, expected) in [
        (
            "unsaid.npz",
            &["--swaps"][..],
            1,
            "--swaps: DIR/unsaid.npz: `meta.settings`: found null, expected the simulator's",
        ),
        ("fresh.npz", &[], 1, "DIR/fresh.npz: found seed 2019002"),
        ("text.npz", &[], 1, "DIR/text.npz: not an .npz file"),
        ("missing.npz", &[], 66, "DIR/missing.npz: No such file"),
    ] {
        let out = path("will not do");
        let mut command = trainer(&["compare", "--profile", "smoke", "--methods", "features"]);
        command.args(more).arg("--data").arg(path(name));
        let output = command.arg("--out").arg(&out).output().unwrap();
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{error}");
        let expected = expected.replace("DIR", data().0.path().to_str().unwrap());
        assert!(error.contains(&expected), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
        assert!(!out.exists(), "{name}");
    }
}

#[test]
fn data_that_a_comparison_is_no_measure_of_is_warned_of() {
    let path = data().0.path().join("odd.npz");
    let mut samples = Dataset::read(&data().1).unwrap().samples;
    let (object, material) = (samples[0].object, samples[0].material);
    let of_level = samples.iter_mut().filter(|sample| sample.level == 1);
    for sample in of_level {
        (sample.object, sample.material) = (object, material);
    }
    write_data(&path, &samples, &serde_json::json!({"pitch_mm": 2.0}));
    // The warning comes before anything is made. Making the directory fails here.
    let mut command = trainer(&["compare", "--profile", "smoke", "--out", "/dev/null/no"]);
    let output = command.arg("--data").arg(&path).output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(74), "{message}");
    for expected in [
        "object 0 is in both splits",
        "taxel pitch: found 2 mm, expected 3.5 mm, that of the simulated test objects",
    ] {
        let expected = format!("warning: {}: {expected}", path.display());
        assert_eq!(message.matches(&expected).count(), 1, "{message}");
    }
    assert_eq!(message.lines().count(), 3, "{message}");
    // Evaluating a model gives the same warning.
    let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/hrn.onnx");
    let data = path.to_str().unwrap();
    let output = hrn_train(&["evaluate", "--model", model, "--data", data]);
    succeeded(&output);
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(message.contains("object 0 is in both splits"), "{message}");
}

#[test]
fn a_stopped_or_killed_comparison_takes_its_runs_with_it_and_goes_on() {
    let comparison = Comparison::new("killed", "hrn100,features", &["--jobs", "1"]);
    let mut finished = Vec::new();
    for (signal, code) in [("-TERM", Some(143)), ("-KILL", None)] {
        let mut process: Child = comparison.command().stderr(Stdio::null()).spawn().unwrap();
        // Wait until one more run is done.
        while comparison.models().len() == finished.len() {
            assert!(process.try_wait().unwrap().is_none(), "ended by itself");
            std::thread::sleep(Duration::from_millis(10));
        }
        let pid = process.id().to_string();
        Command::new("kill").args([signal, &pid]).status().unwrap();
        assert_eq!(process.wait().unwrap().code(), code, "{signal}");
        let began = Instant::now();
        while at_work_in(&comparison.out) {
            let waited = began.elapsed();
            assert!(
                waited < Duration::from_secs(20),
                "runs outlive it after {signal}"
            );
            std::thread::sleep(Duration::from_millis(10));
        }
        finished = comparison.models();
        assert!(finished.len() < 6, "{signal} came too late");
    }
    let errors = comparison.run();
    let models = comparison.models();
    assert!(
        finished.iter().all(|model| models.contains(model)),
        "{errors}"
    );
    assert_eq!(comparison.json("results.json").len(), 6);
    // Apart from their seconds, the runs are the same.
    let without_price = |results: Vec<Value>| -> Vec<Value> {
        let without = |mut result: Value| {
            result.as_object_mut().unwrap().remove("seconds");
            result
        };
        results.into_iter().map(without).collect()
    };
    assert_eq!(
        without_price(comparison.json("results.json")),
        without_price(whole().json("results.json"))
    );
}

/// Whether a process has this directory on its command line.
fn at_work_in(directory: &Path) -> bool {
    let directory = directory.to_str().unwrap();
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let commands = processes.filter_map(|entry| std::fs::read(entry.path().join("cmdline")).ok());
    commands
        .map(|command| String::from_utf8_lossy(&command).into_owned())
        .any(|command| command.contains(directory))
}

#[test]
fn a_failing_run_is_named_and_the_others_go_on() {
    let more = ["--jobs", "1", "--swaps"].as_slice();
    let comparison = Comparison::new("failing", "hrn100,features", more);
    // One file stops the swaps before they begin. Another is where a run needs a directory.
    let swapped = comparison.out.join("runs/features-swapped-none-1");
    std::fs::create_dir_all(&swapped).unwrap();
    std::fs::write(swapped.join("settings.toml"), "neither").unwrap();
    std::fs::create_dir_all(comparison.out.join("runs/hrn100-1")).unwrap();
    std::fs::write(comparison.out.join("runs/hrn100-1/checkpoints"), "").unwrap();
    let output = comparison.command().output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    let last = errors.lines().last().unwrap();
    assert!(
        last.contains("1 run failed") && last.contains("hrn100-1"),
        "{last}"
    );
    assert!(
        last.contains("features-swapped-none-1/settings.toml"),
        "{last}"
    );
    assert_eq!(comparison.json("results.json").len(), 5);
}

#[test]
fn a_report_needs_no_network_and_has_all_its_sections() {
    let directory = whole().out.to_str().unwrap();
    let out = data().0.path().join("report.html");
    succeed(&["report", directory, "--out", out.to_str().unwrap()]);
    let page = std::fs::read_to_string(&out).unwrap();
    assert_eq!(page, whole().text("report.html"), "compare writes the same");
    check_page(&page, &["tables", "training", "samples", "calibration"]);
    assert!(page.contains("(95.9)"), "the paper's figures");
    assert!(page.contains("@media (prefers-color-scheme: dark)"));

    let run = whole().out.join("runs/hrn100-1");
    std::fs::remove_file(&out).unwrap();
    succeed(&[
        "report",
        run.to_str().unwrap(),
        "--out",
        out.to_str().unwrap(),
    ]);
    let page = std::fs::read_to_string(&out).unwrap();
    let sections = [
        "evaluation",
        "sets",
        "steps",
        "calibration",
        "samples",
        "settings",
    ];
    check_page(&page, &sections);
    assert!(
        page.contains("<td>broad wide</td>"),
        "the comparison's other sets"
    );
    assert!(
        page.contains("data:image/png;base64,"),
        "its own pictures are in it"
    );

    let missing = data().0.path().join("nowhere");
    let output = hrn_train(&["report", missing.to_str().unwrap(), "--out", "/dev/null"]);
    assert_eq!(output.status.code(), Some(66));
}

/// Checks that a page loads nothing, and links only to its own sections, which are `sections`.
fn check_page(page: &str, sections: &[&str]) {
    for foreign in [
        "http:", "https:", "//", "@import", "<script", "<link", "url(",
    ] {
        let inside = |line: &&str| line.contains(foreign) && !line.contains("data:image/png");
        let line = page.lines().find(inside);
        assert!(line.is_none(), "{foreign} in {line:?}");
    }
    for section in sections {
        assert!(
            page.contains(&format!("<h2 id=\"{section}\">")),
            "no {section}"
        );
        assert!(
            page.contains(&format!("href=\"#{section}\"")),
            "no link to {section}"
        );
    }
    assert_eq!(page.matches("<h2 id=").count(), sections.len());
    assert_eq!(
        page.matches("<figure>").count(),
        page.matches("</figure>").count()
    );
}
