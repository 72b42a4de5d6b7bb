//! Framed groups of nodes: each is a lane of the whole width, one below the other, so that no two frames overlap. The
//! texts of edges between lanes stand between the frames, beside their arrows.

use super::layout::{EdgePath, Item, Sizes};

/// Above a frame's nodes, for its name.
pub(super) const FRAME_HEAD: f64 = 36.0;
/// Below a frame's nodes, and left and right of them.
pub(super) const FRAME_PADDING: f64 = 18.0;
/// The least distance of frames.
const FRAME_GAP: f64 = 20.0;
/// Between texts, and between a text and its arrow or a frame.
const TEXT_GAP: f64 = 8.0;
/// Of more groups not all orders are tried.
const MAX_ORDERED: usize = 6;

/// Where an edge leaves its lane.
pub(super) struct Crossing {
    edge: usize,
    /// Between this piece of its way and the next.
    piece: usize,
    /// The lane above the gap where its text stands.
    above: usize,
    column: usize,
}

/// The place of each group from above, so that the ways between groups are short; as given where that is as good.
pub(super) fn order_of(n_groups: usize, joined: &[(usize, usize)]) -> Vec<usize> {
    let identity: Vec<usize> = (0..n_groups).collect();
    let length = |places: &[usize]| joined.iter().map(|&(a, b)| places[a].abs_diff(places[b])).sum::<usize>();
    let mut best = identity.clone();
    if n_groups <= MAX_ORDERED {
        let mut places = identity;
        while next_permutation(&mut places) {
            if length(&places) < length(&best) {
                best.clone_from(&places);
            }
        }
    }
    best
}

/// The next one in lexicographic order.
fn next_permutation(places: &mut [usize]) -> bool {
    let Some(pivot) = (1..places.len()).rev().find(|&idx| places[idx - 1] < places[idx]) else { return false };
    if let Some(larger) = (pivot..places.len()).rev().find(|&idx| places[idx] > places[pivot - 1]) {
        places.swap(pivot - 1, larger);
    }
    places[pivot..].reverse();
    true
}

/// The lane in which an edge between two lanes passes by columns: the emptier one there.
pub(super) fn passing_lane((from, to): (usize, usize), sizes: &Sizes, columns: &[usize]) -> usize {
    let n_nodes = |lane: usize| {
        let between = |&node: &usize| columns[from] < columns[node] && columns[node] < columns[to];
        (0..columns.len()).filter(|&node| sizes.lanes[node] == lane).filter(between).count()
    };
    let (from, to) = (sizes.lanes[from], sizes.lanes[to]);
    if n_nodes(from) < n_nodes(to) { from } else { to }
}

pub(super) fn crossings(chains: &[Vec<usize>], items: &[Item]) -> Vec<Crossing> {
    let found = chains.iter().enumerate().filter_map(|(edge, chain)| {
        let piece = chain.windows(2).position(|pair| items[pair[0]].lane != items[pair[1]].lane)?;
        let (from, to) = (items[chain[piece]].lane, items[chain[piece + 1]].lane);
        Some(Crossing {
            edge,
            piece,
            above: if from < to { from } else { from - 1 },
            column: items[chain[piece + 1]].column,
        })
    });
    found.collect()
}

/// The distance from a lane's frame to the next one.
pub(super) fn gap_below(lane: usize, crossings: &[Crossing], sizes: &Sizes) -> f64 {
    let here = || crossings.iter().filter(|crossing| crossing.above == lane);
    let stack = |column: usize| {
        let texts = here().filter(|crossing| crossing.column == column);
        texts.map(|crossing| sizes.edges[crossing.edge].2[1] + TEXT_GAP).sum::<f64>() + TEXT_GAP
    };
    here().map(|crossing| stack(crossing.column)).fold(FRAME_GAP, f64::max)
}

/// Puts the texts of edges between lanes into the gaps, those of one column below each other.
pub(super) fn place_texts(edges: &mut [EdgePath], crossings: &[Crossing], sizes: &Sizes, frames: &[[f64; 2]]) {
    let start = |edges: &[EdgePath], crossing: &Crossing| edges[crossing.edge].pieces[crossing.piece][1];
    let mut from_above: Vec<&Crossing> = crossings.iter().collect();
    from_above.sort_by(|a, b| start(edges, a)[1].total_cmp(&start(edges, b)[1]));
    for (idx, crossing) in from_above.iter().enumerate() {
        let height = |other: &Crossing| sizes.edges[other.edge].2[1] + TEXT_GAP;
        let is_same = |other: &&&Crossing| (other.above, other.column) == (crossing.above, crossing.column);
        let total: f64 = from_above.iter().filter(is_same).map(|other| height(other)).sum();
        let before: f64 = from_above[..idx].iter().filter(is_same).map(|other| height(other)).sum();
        let middle = (frames[crossing.above][1] + frames[crossing.above + 1][0]) / 2.0;
        let y = middle - total / 2.0 + before + height(crossing) / 2.0;
        let [width, text_height] = sizes.edges[crossing.edge].2;
        let path = &mut edges[crossing.edge];
        let ends = (path.pieces[crossing.piece][1], path.pieces[crossing.piece + 1][0]);
        let beside =
            [y - text_height / 2.0, y + text_height / 2.0].map(|y| x_at(y, ends)).into_iter().fold(0.0, f64::max);
        path.label = [beside + TEXT_GAP + width / 2.0, y];
        path.is_beside = true;
    }
}

/// Where an arrow's curve, whose handles are level and reach to the middle, is at this height.
fn x_at(y: f64, ([x0, y0], [x1, y1]): ([f64; 2], [f64; 2])) -> f64 {
    let share = ((y - y0) / (y1 - y0)).clamp(0.0, 1.0);
    let (mut low, mut high) = (0.0_f64, 1.0_f64);
    for _ in 0..40 {
        let t = (low + high) / 2.0;
        if t * t * (3.0 - 2.0 * t) < share { low = t } else { high = t }
    }
    let (t, middle) = (low, (x0 + x1) / 2.0);
    let back = 1.0 - t;
    x0 * back.powi(3) + 3.0 * middle * t * back * (back + t) + x1 * t.powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_that_are_joined_are_neighbours() {
        assert_eq!(order_of(0, &[]), [0_usize; 0]);
        assert_eq!(order_of(3, &[(0, 1), (1, 2)]), [0, 1, 2]);
        // Robot, laptop, brain: nothing goes to the laptop.
        assert_eq!(order_of(3, &[(0, 2), (2, 0)]), [0, 2, 1]);
        // Three robots around one brain: it stands between them.
        let places = order_of(4, &[(0, 3), (1, 3), (2, 3)]);
        assert!([1, 2].contains(&places[3]), "{places:?}");
        assert_eq!(order_of(9, &[(0, 8)]), (0..9).collect::<Vec<_>>());
    }

    #[test]
    fn a_curve_is_found_at_its_heights() {
        let ends = ([10.0, 0.0], [110.0, 80.0]);
        for (y, x) in [(0.0, 10.0), (40.0, 60.0), (80.0, 110.0), (-5.0, 10.0)] {
            assert!((x_at(y, ends) - x).abs() < 1e-6, "{y}: {}", x_at(y, ends));
        }
        // Rising ones, too.
        assert!((x_at(40.0, ([10.0, 80.0], [110.0, 0.0])) - 60.0).abs() < 1e-6);
    }
}
