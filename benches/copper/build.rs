//! Tells Copper's macros where the texts of log lines are kept.

fn main() {
    cu29_build::setup();
}
