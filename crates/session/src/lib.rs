//! A run of a graph as the commands `run`, `trials`, `replay` and `test` have it: with decisions on stdout, a recording and a
//! summary.
//!
//! * [`run`] - the run itself. [`recorder`] - records samples beside it. [`table`] - its summary.
//! * [`span`] - what a recorder beside a running graph records. [`flight`] - the last seconds of a graph, kept in memory.
//! * [`of_graph`] - the facts about a graph that its recording holds.
//! * [`output`] - files to write, checked before the work begins. [`text_table`] and [`console`] - tables and colours for
//!   people.

pub mod console;
pub mod flight;
pub mod of_graph;
pub mod output;
pub mod recorder;
pub mod run;
pub mod span;
pub mod table;
pub mod text_table;
