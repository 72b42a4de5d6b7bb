//! Trials as tables: the paper's Tables II, III and IV beside its own figures, and the effect of the decision.

use serde::{Deserialize, Serialize};

use super::late_decisions::LateDecisions;
use super::tally::{GateEffect, Tallies, Tally, TrialRecord};
use crate::evaluation::statistics::Estimate;
use blindgrasp_messages::hex_id;
use blindgrasp_simulator::trial::TrialOptions;
use blindgrasp_simulator::trial::targets::{N_PAPER_TRIALS_EACH, held_in_paper};
use blindgrasp_simulator::wrench_space::{STABLE_EPSILON, STABLE_VOLUME};
use blindgrasp_stages::training_summary::Bounded;

/// A run of trials and its results.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct TrialsReport {
    /// The command as it could be given again.
    pub command: String,
    /// The objects, as they were asked for.
    pub objects: String,
    /// Trials asked for.
    pub n_trials: u64,
    /// Most attempts in a trial.
    pub max_attempts: u32,
    /// Seed of everything random.
    pub seed: u64,
    /// The shard's index and the number of shards; the records are those of the shard alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shard: Option<(u64, u64)>,
    pub options: TrialOptions,
    /// File of the model that decided.
    pub model: String,
    /// A digest of the graph's params, by which `trials --merge` tells runs apart.
    #[serde(default, with = "hex_id")]
    pub graph_id: u64,
    /// `finished`, or `stopped` before all was done.
    pub end: String,
    /// With the gate: lifted when the graph said so.
    #[serde(skip_deserializing)]
    pub with_gate: Option<Tallies>,
    /// Every settled grasp lifted.
    #[serde(skip_deserializing)]
    pub without_gate: Option<Tallies>,
    /// Attempts that were not lifted because the host was slow. `None` without trials by decision.
    pub late: Option<LateDecisions>,
    /// Trials left out because no approach led to the object, of the way that has more of them.
    pub n_left_out: u64,
    /// The effect of the decision; only if there are trials both ways.
    #[serde(skip_deserializing)]
    pub effect: Option<GateEffect>,
    /// All attempts with the gate.
    pub records_with_gate: Vec<TrialRecord>,
    /// All attempts without.
    pub records_without_gate: Vec<TrialRecord>,
}

/// Puts the records of all shards in order, as if one robot had made them: each shard numbers its grasps and its time from 0.
fn in_order(shards: Vec<Vec<TrialRecord>>) -> Vec<TrialRecord> {
    let mut records = Vec::new();
    for shard in shards {
        let mut before = 0.0;
        for record in shard {
            let end_secs = record.end_secs - before;
            before = record.end_secs;
            records.push(TrialRecord { end_secs, ..record });
        }
    }
    records.sort_by_key(|record| (record.trial, record.attempt));
    let mut secs = 0.0;
    for (grasp_id, record) in (0..).zip(&mut records) {
        secs += record.end_secs;
        (record.grasp_id, record.end_secs) = (grasp_id, secs);
    }
    records
}

impl TrialsReport {
    /// The report of a whole run, from the reports of all its shards, in the order of the shards.
    pub fn merge(shards: Vec<TrialsReport>) -> TrialsReport {
        let (mut whole, mut with_gate, mut without_gate) = (None::<TrialsReport>, Vec::new(), Vec::new());
        for mut report in shards {
            with_gate.push(std::mem::take(&mut report.records_with_gate));
            without_gate.push(std::mem::take(&mut report.records_without_gate));
            let Some(known) = &mut whole else {
                whole = Some(report);
                continue;
            };
            if let (Some(late), Some(more)) = (&mut known.late, report.late) {
                late.n_stale += more.n_stale;
                late.n_undecided += more.n_undecided;
            }
            known.n_left_out += report.n_left_out;
        }
        let mut whole = whole.unwrap_or_default();
        if let Some((idx, n)) = whole.shard.take() {
            for given in [format!(" --shard {idx}/{n}"), format!(" --shard={idx}/{n}")] {
                whole.command = whole.command.replace(&given, "");
            }
        }
        (whole.records_with_gate, whole.records_without_gate) = (in_order(with_gate), in_order(without_gate));
        whole.count();
        whole
    }

    /// Whether both are shards of one run.
    pub fn is_of_run(&self, other: &TrialsReport) -> bool {
        let [ours, theirs] = [self, other].map(|report| {
            let n_shards = report.shard.map(|(_, n)| n);
            let numbers =
                (n_shards, report.n_trials, report.max_attempts, report.seed, report.graph_id, report.late.is_some());
            (numbers, &report.objects, &report.model, &report.options)
        });
        // A shard without an attempt does not tell which ways were run.
        let [our_ways, their_ways] =
            [self, other].map(|report| (!report.records_with_gate.is_empty(), !report.records_without_gate.is_empty()));
        let tells_ways = our_ways != (false, false) && their_ways != (false, false);
        ours == theirs && (!tells_ways || our_ways == their_ways)
    }

    /// Counts; an empty list of records is a way that was not run.
    pub fn count(&mut self) {
        let (with, without) = (&self.records_with_gate, &self.records_without_gate);
        let is_finished = self.end == "finished";
        let tallies = |records: &[TrialRecord]| {
            (!records.is_empty()).then(|| Tallies::new(records, self.max_attempts, is_finished))
        };
        (self.with_gate, self.without_gate) = (tallies(with), tallies(without));
        let both = !with.is_empty() && !without.is_empty();
        self.effect = both.then(|| GateEffect::new(with, without, self.max_attempts, is_finished));
    }

    /// How many trials reached, lifted and kept their object, and in how many attempts: a sentence for each way.
    pub fn in_four_numbers(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (name, Tallies { n_reached, total, .. }) in self.ways() {
            let Tally { n_lifts, n_held, n_attempts, .. } = total;
            let mut line = format!(
                "Of {} trials, {name}: {n_reached} reached the object, {n_lifts} lifted it, {n_held} kept it, in {n_attempts} attempts.",
                self.n_trials
            );
            if self.n_left_out > 0 {
                line += &format!(" No approach led to the object in {}: these are left out.", self.n_left_out);
            }
            lines.push(line);
        }
        lines
    }

    /// What there is to show: the ways that were run, with what columns call them.
    fn ways(&self) -> Vec<(&'static str, &Tallies)> {
        let ways = [("with the gate", &self.with_gate), ("every grasp lifted", &self.without_gate)];
        ways.into_iter().filter_map(|(name, tallies)| Some((name, tallies.as_ref()?))).collect()
    }
}

/// A table to be read, as text or on a page.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Table {
    /// Its title.
    pub title: String,
    /// Its columns. The first one holds names, the others numbers.
    pub head: Vec<String>,
    /// A cell for each column.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// Lines of aligned text.
    pub fn to_text(&self) -> Vec<String> {
        let width = |column: usize| {
            let cells = self.rows.iter().chain([&self.head]).filter_map(|row| row.get(column));
            cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.head.len()).map(width).collect();
        let line = |row: &Vec<String>| {
            let cells = row.iter().zip(&widths).enumerate();
            let cells = cells.map(|(column, (cell, &width))| match column {
                0 => format!("{cell:<width$}"),
                _ => format!("{cell:>width$}"),
            });
            cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
        };
        std::iter::once(self.title.clone()).chain([line(&self.head)]).chain(self.rows.iter().map(line)).collect()
    }
}

/// All tables of a report. Tables III and IV are only there if their things are.
pub fn tables(report: &TrialsReport) -> Vec<Table> {
    let tables = [
        Some(table_2(report)),
        by_mass(
            report,
            "Table III: the canteen by surface and mass",
            &["0.50 kg", "0.75 kg"],
            &["canteen without cover", "canteen with cover"],
        ),
        by_mass(report, "Table IV: the mug by mass", &["0.43 kg", "0.68 kg", "0.93 kg"], &["mug"]),
        Some(attempts(report)),
        Some(cost(report)),
        promises(report),
        gate(report),
        Some(closure(report)),
    ];
    tables.into_iter().flatten().collect()
}

/// Lifts held, by group.
fn table_2(report: &TrialsReport) -> Table {
    let ways = report.ways();
    let has_paper = ways.iter().any(|(_, tallies)| tallies.groups.iter().any(|group| group.paper.is_some()));
    let mut head = vec!["object".to_string(), "mass, kg".into()];
    head.extend(ways.iter().map(|(name, _)| format!("kept, {name}")));
    head.extend(has_paper.then(|| "paper".to_string()));
    let row = |tally: &Tally, find: &dyn Fn(&Tallies) -> Option<Tally>| {
        let mut row = vec![tally.name.clone(), range(tally.mass_kg)];
        row.extend(ways.iter().map(|(_, tallies)| find(tallies).map_or("-".into(), |tally| held(&tally))));
        row.extend(has_paper.then(|| tally.paper.map_or("-".into(), part_of_whole)));
        row
    };
    let mut rows = Vec::new();
    for name in names(&ways, |tallies| &tallies.groups) {
        let find = |tallies: &Tallies| tallies.groups.iter().find(|tally| tally.name == name).cloned();
        let first = ways.iter().find_map(|(_, tallies)| find(tallies));
        rows.extend(first.map(|tally| row(&tally, &find)));
    }
    if let Some((_, tallies)) = ways.first() {
        rows.push(row(&tallies.total, &|tallies| Some(tallies.total.clone())));
    }
    Table { title: "Table II: lifts that kept the object (95 % interval)".into(), head, rows }
}

/// A line for each object and way, a column for each mass, and the paper's figures.
fn by_mass(report: &TrialsReport, title: &str, masses: &[&str], names: &[&str]) -> Option<Table> {
    let mut rows = Vec::new();
    for name in names {
        let things: Vec<String> = masses.iter().map(|mass| format!("{name}, {mass}")).collect();
        let n_before = rows.len();
        for (way, tallies) in report.ways() {
            let find = |thing: &String| tallies.things.iter().find(|tally| tally.name == *thing);
            if things.iter().any(|thing| find(thing).is_some()) {
                let found = things.iter().map(|thing| find(thing).map_or("-".into(), held));
                rows.push([format!("{name}, {way}")].into_iter().chain(found).collect::<Vec<_>>());
            }
        }
        if rows.len() > n_before {
            let mut row = vec![format!("{name}, paper")];
            for thing in &things {
                let n_held = held_in_paper(thing);
                row.push(n_held.map_or("-".into(), |n_held| part_of_whole([n_held, N_PAPER_TRIALS_EACH])));
            }
            rows.push(row);
        }
    }
    let head = std::iter::once("object").chain(masses.iter().copied()).map(String::from).collect();
    (!rows.is_empty()).then(|| Table { title: title.into(), head, rows })
}

/// What lifting cost, with the gate if it was run.
fn attempts(report: &TrialsReport) -> Table {
    let head =
        ["object", "trials", "attempts", "lifts", "kept", "given up", "attempts per lift", "attempts per kept object"];
    let number = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.2}"));
    let row = |tally: &Tally| {
        let Tally { n_trials, n_attempts, n_lifts, n_held, n_given_up, .. } = *tally;
        let counts = [n_trials, n_attempts, n_lifts, n_held, n_given_up];
        let counts = counts.into_iter().map(|count| count.to_string());
        let rates = [tally.attempts_per_lift, tally.attempts_per_held].map(number);
        std::iter::once(tally.name.clone()).chain(counts).chain(rates).collect()
    };
    let ways = report.ways();
    let way = ways.first();
    let rows = way.iter().flat_map(|(_, tallies)| tallies.things.iter().chain([&tallies.total])).map(row);
    let title = way.map_or("Attempts".into(), |(name, _)| format!("Attempts by object, {name}"));
    Table { title, head: head.map(String::from).into(), rows: rows.collect() }
}

/// What each way costs.
fn cost(report: &TrialsReport) -> Table {
    let number = |value: Option<f64>, digits: usize| value.map_or("-".into(), |value| format!("{value:.digits$}"));
    let row = |(name, tallies): &(&'static str, &Tallies)| {
        let total = &tallies.total;
        vec![
            (*name).to_string(),
            number(total.attempts_per_lift, 2),
            number(total.attempts_per_held, 2),
            part_of_whole([total.n_given_up, total.n_trials]),
            part_of_whole([tallies.n_probes, total.n_attempts]),
            part_of_whole([tallies.n_disturbed, tallies.n_probes]),
            tallies.n_tightened.to_string(),
            tallies.n_set_down.to_string(),
            number(tallies.kept_per_hour, 0),
        ]
    };
    let head = [
        "",
        "attempts per lift",
        "attempts per kept object",
        "given up",
        "with a probe",
        "disturbed",
        "tightened",
        "set down",
        "kept per hour",
    ];
    Table {
        title: "Cost, in the robot's time".into(),
        head: head.map(String::from).into(),
        rows: report.ways().iter().map(row).collect(),
    }
}

/// The bounds of drops for new objects.
fn promises(report: &TrialsReport) -> Option<Table> {
    let cells =
        |bounded: &Bounded| [format!("{:.1} %", 100.0 * bounded.estimate), format!("{:.1} %", 100.0 * bounded.at_most)];
    let row = |(name, tallies): (&'static str, &Tallies)| {
        let promise = tallies.promise.as_ref()?;
        let figures = [cells(&promise.drops_of_lifts), cells(&promise.drops_of_trials)].into_iter().flatten();
        let n_objects = promise.drops_of_trials.n_objects.to_string();
        Some(std::iter::once(name.to_string()).chain(figures).chain([n_objects]).collect::<Vec<_>>())
    };
    let rows: Vec<Vec<String>> = report.ways().into_iter().filter_map(row).collect();
    let head = ["", "lifts that drop", "at most", "trials that end in a drop", "at most", "objects"];
    (!rows.is_empty()).then(|| Table {
        title: "Bounds for new objects like these, if the model has seen none of these; each with 95 % confidence"
            .into(),
        head: head.map(String::from).into(),
        rows,
    })
}

/// What the gate changed.
fn gate(report: &TrialsReport) -> Option<Table> {
    let effect = report.effect.as_ref()?;
    let of = |part: usize, whole: usize| format!("{part} of {whole}");
    let ratio = effect.attempts_ratio.map_or("-".into(), |ratio| format!("{ratio:.2}"));
    let rows = [
        ("dropped, every grasp lifted", of(effect.n_dropped_without, effect.n_trials)),
        ("dropped, with the gate", of(effect.n_dropped_with, effect.n_trials)),
        ("drops avoided: held or not lifted with the gate", of(effect.n_avoided, effect.n_dropped_without)),
        ("dropped only with the gate", of(effect.n_caused, effect.n_trials)),
        ("given up, though the first grasp holds", of(effect.n_needlessly_given_up, effect.n_trials)),
        ("attempts with the gate for each without", ratio),
    ];
    Some(Table {
        title: "What the gate changed, in the same trials".into(),
        head: vec![String::new(), "trials".into()],
        rows: rows.into_iter().map(|(name, value)| vec![name.into(), value]).collect(),
    })
}

/// What the paper's label and force closure are worth in physics.
fn closure(report: &TrialsReport) -> Table {
    let ways = report.ways();
    let names = [
        format!("stable by the paper's label (epsilon > {STABLE_EPSILON}, volume > {STABLE_VOLUME})"),
        "force closure only (epsilon > 0)".into(),
        "no force closure".into(),
    ];
    let rows = names.into_iter().enumerate().map(|(idx, name)| {
        let found = ways.iter().map(|(_, tallies)| match tallies.held_by_closure[idx] {
            [_, 0] => "-".into(),
            counts => part_of_whole(counts),
        });
        std::iter::once(name).chain(found).collect()
    });
    let rows = if ways.is_empty() { Vec::new() } else { rows.collect() };
    let head = std::iter::once("grasp".into()).chain(ways.iter().map(|(name, _)| format!("kept, {name}"))).collect();
    Table { title: "Lifts that kept the object, by what the wrench space of the grasp says".into(), head, rows }
}

/// Names of all ways, each once.
fn names<'a>(ways: &[(&str, &'a Tallies)], of: impl Fn(&'a Tallies) -> &'a Vec<Tally>) -> Vec<&'a str> {
    let mut names: Vec<&str> = Vec::new();
    for tally in ways.iter().flat_map(|(_, tallies)| of(tallies)) {
        if !names.contains(&tally.name.as_str()) {
            names.push(&tally.name);
        }
    }
    names
}

/// `9 of 10, 90 % (60-98)`; `-` without lifts.
fn held(tally: &Tally) -> String {
    let Some(Estimate { value, interval }) = tally.success else { return "-".into() };
    let interval = interval
        .map_or(String::new(), |interval| format!(" ({:.0}-{:.0})", 100.0 * interval.low, 100.0 * interval.high));
    format!("{} of {}, {:.0} %{interval}", tally.n_held, tally.n_lifts, 100.0 * value)
}

pub(super) fn part_of_whole([part, whole]: [usize; 2]) -> String {
    if whole == 0 {
        return "-".into();
    }
    format!("{part} of {whole}, {:.0} %", 100.0 * part as f64 / whole as f64)
}

fn range([least, most]: [f64; 2]) -> String {
    if least == most { format!("{least:.2}") } else { format!("{least:.2}-{most:.2}") }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::trials::tally::tests::records;

    pub(in crate::trials) fn report(with: Vec<TrialRecord>, without: Vec<TrialRecord>) -> TrialsReport {
        let mut report = TrialsReport {
            command: "blindgrasp trials".into(),
            objects: "paper".into(),
            n_trials: 110,
            max_attempts: 3,
            seed: 1,
            model: "models/<any>.json".into(),
            end: "finished".into(),
            records_with_gate: with,
            records_without_gate: without,
            ..TrialsReport::default()
        };
        report.count();
        report
    }

    pub(in crate::trials) fn both() -> TrialsReport {
        let things = [
            ("mug, 0.43 kg", "mug", 0.43),
            ("mug, 0.93 kg", "mug", 0.93),
            ("canteen with cover, 0.50 kg", "canteen", 0.5),
            ("decorative rock", "rock", 0.28),
        ];
        let made = |attempts: [&'static str; 4]| {
            let trials: Vec<_> = things.iter().zip(attempts).map(|((a, b, c), what)| (*a, *b, *c, what)).collect();
            records(&trials)
        };
        report(made(["h", "-h", "-d", "---"]), made(["h", "d", "h", "d"]))
    }

    #[test]
    fn the_reports_of_all_shards_are_that_of_the_whole() {
        // Each run numbers its grasps and its time from 0, and an attempt takes 10 s.
        let counted = |mut report: TrialsReport| {
            for records in [&mut report.records_with_gate, &mut report.records_without_gate] {
                for (idx, record) in records.iter_mut().enumerate() {
                    (record.grasp_id, record.end_secs) = (idx as u64, 10.0 * (idx + 1) as f64);
                }
            }
            report.count();
            report
        };
        let whole = counted(both());
        let shard = |idx: u64| {
            let mut part =
                TrialsReport { shard: Some((idx, 2)), late: Some(LateDecisions::default()), ..whole.clone() };
            part.records_with_gate.retain(|record| record.trial % 2 == idx);
            part.records_without_gate.retain(|record| record.trial % 2 == idx);
            let part = counted(part);
            // As a file has it.
            serde_json::from_str::<TrialsReport>(&serde_json::to_string(&part).expect("JSON")).expect("a report")
        };
        let merged = TrialsReport::merge(vec![shard(0), shard(1)]);
        let [found, expected] = [&merged, &whole].map(|report| report.with_gate.as_ref().expect("trials"));
        assert_eq!((found.n_probes, found.kept_per_hour), (expected.n_probes, expected.kept_per_hour));
        let names =
            |report: &TrialsReport| report.records_with_gate.iter().map(|r| (r.trial, r.attempt)).collect::<Vec<_>>();
        assert_eq!(names(&merged), names(&whole));
        let text = |report: &TrialsReport| tables(report).iter().flat_map(Table::to_text).collect::<Vec<_>>();
        assert_eq!(text(&merged), text(&whole));
        let other = TrialsReport { seed: 2, ..shard(0) };
        let one_way = TrialsReport { records_without_gate: Vec::new(), ..shard(0) };
        let other_graph = TrialsReport { graph_id: 7, ..shard(0) };
        for part in [other, one_way, other_graph] {
            assert!(!shard(1).is_of_run(&part), "{part:?}");
        }
    }

    #[test]
    fn the_papers_tables_have_its_figures_beside() {
        let text: Vec<String> = tables(&both()).iter().flat_map(Table::to_text).collect();
        let text = text.join("\n");
        assert!(text.starts_with("Table II: lifts that kept the object (95 % interval)\nobject    mass, kg"), "{text}");
        for line in [
            "mug      0.43-0.93  2 of 2, 100 % (34-100)",
            "20 of 20, 100 %",
            "total    0.28-0.93",
            "Table III: the canteen by surface and mass",
            "canteen with cover, with the gate",
            "Table IV: the mug by mass",
            "10 of 10, 100 %",
            "stable by the paper's label (epsilon > 0.07, volume > 0.1)",
            "force closure only (epsilon > 0)",
            "drops avoided: held or not lifted with the gate  2 of 2",
            "dropped only with the gate                       1 of 4",
            "attempts with the gate for each without            2.00",
        ] {
            assert!(text.contains(line), "no '{line}' in\n{text}");
        }
        assert!(!text.contains("canteen without cover"), "{text}");
    }

    #[test]
    fn columns_are_aligned_whatever_the_letters() {
        let table = Table {
            title: "T".into(),
            head: vec!["a".into(), "n".into()],
            rows: vec![vec!["größer".into(), "1".into()], vec!["b".into(), "10 %".into()]],
        };
        assert_eq!(table.to_text(), ["T", "a          n", "größer     1", "b       10 %"]);
    }

    #[test]
    fn one_way_alone_has_no_columns_of_the_other_and_no_effect() {
        let alone = report(records(&[("box-02", "box", 0.1, "-h")]), Vec::new());
        let tables = tables(&alone);
        assert_eq!(tables.len(), 5, "{tables:?}");
        assert_eq!(tables[0].head, ["object", "mass, kg", "kept, with the gate"]);
        assert_eq!(tables[0].rows[0][2], "1 of 1, 100 % (21-100)");
    }

    #[test]
    fn a_trial_with_an_attempt_is_reached_however_it_ends() {
        let mut report = report(records(&[("box", "box", 0.1, "-h"), ("lemon", "lemon", 0.1, "--")]), Vec::new());
        (report.n_trials, report.n_left_out) = (5, 3);
        assert_eq!(
            report.in_four_numbers(),
            [
                "Of 5 trials, with the gate: 2 reached the object, 1 lifted it, 1 kept it, in 4 attempts. No approach led to the object \
              in 3: these are left out."
            ]
        );
    }

    #[test]
    fn nothing_done_is_a_table_without_rows() {
        let none = report(Vec::new(), Vec::new());
        assert!(tables(&none).iter().all(|table| table.rows.is_empty()));
    }
}
