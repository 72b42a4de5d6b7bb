//! Where the boxes and arrows of a graph go: columns by longest path, the order in a column by barycentre, heights so
//! that arrows are as level as the boxes' distances allow (least squares). Nodes of a group are in a lane of their own.

#[cfg(test)]
mod tests;

use super::lanes::{FRAME_HEAD, FRAME_PADDING, crossings, gap_below, passing_lane, place_texts};

/// What is to be placed; all lengths in pixels.
pub(super) struct Sizes {
    /// Width and height of each node.
    pub(super) nodes: Vec<[f64; 2]>,
    /// From, to, and the size of the text at the edge.
    pub(super) edges: Vec<(usize, usize, [f64; 2])>,
    /// The lane of each node, from above.
    pub(super) lanes: Vec<usize>,
    /// How many lanes have frames, the upper ones; without frames there is one lane.
    pub(super) n_frames: usize,
}

/// Where it goes. The picture begins at 0, 0.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layout {
    pub(super) width: f64,
    pub(super) height: f64,
    /// The centre of each node.
    pub(super) nodes: Vec<[f64; 2]>,
    pub(super) edges: Vec<EdgePath>,
    /// Upper and lower end of each frame, which reaches beyond the picture by [`FRAME_PADDING`] on both sides.
    pub(super) frames: Vec<[f64; 2]>,
}

/// The way of an edge.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct EdgePath {
    /// Level pieces, each a start and an end, from left to right; curves join them.
    pub(super) pieces: Vec<[[f64; 2]; 2]>,
    /// The centre of its text.
    pub(super) label: [f64; 2],
    /// Whether its text stands right of it, between two frames.
    pub(super) is_beside: bool,
}

/// Between boxes of a column.
const NODE_GAP: f64 = 26.0;
/// Left and right of an edge's text.
const LABEL_GAP: f64 = 28.0;
/// The least distance of columns.
const COLUMN_GAP: f64 = 64.0;
/// Between the ends of edges on a box's side.
const END_GAP: f64 = 12.0;
/// How often the order is improved; it settles long before.
const N_SWEEPS: usize = 24;
/// How often the heights are: a slope goes out of a chain a box at a time.
const N_LEVELLINGS: usize = 200;

/// A place in a column: a node's, or that of an edge passing by, with room for its text if it stands there.
pub(super) struct Item {
    pub(super) column: usize,
    pub(super) lane: usize,
    is_node: bool,
    /// How far it reaches above its y.
    above: f64,
    below: f64,
    width: f64,
    left: Vec<usize>,
    right: Vec<usize>,
}

/// Lays out a graph. An edge against the direction of the others is drawn, but not beautifully.
pub(super) fn layout(sizes: &Sizes) -> Layout {
    let columns = columns_by_longest_path(sizes.nodes.len(), &sizes.edges);
    let mut items: Vec<Item> = (sizes.nodes.iter().zip(&columns).zip(&sizes.lanes))
        .map(|((&[width, height], &column), &lane)| Item {
            column,
            lane,
            is_node: true,
            above: height / 2.0,
            below: height / 2.0,
            width,
            left: Vec::new(),
            right: Vec::new(),
        })
        .collect();
    let chains: Vec<Vec<usize>> = sizes.edges.iter().map(|edge| chain_of(edge, sizes, &columns, &mut items)).collect();
    let n_columns = items.iter().map(|item| item.column + 1).max().unwrap_or(0);
    let mut order: Vec<Vec<usize>> = vec![Vec::new(); n_columns];
    (0..items.len()).for_each(|idx| order[items[idx].column].push(idx));
    order_by_barycentre(&mut order, &items);
    let crossings = crossings(&chains, &items);
    let has_frames = sizes.n_frames > 0;
    let n_lanes = items.iter().map(|item| item.lane + 1).fold(sizes.n_frames.max(1), usize::max);
    let mut ys = vec![0.0; items.len()];
    let (mut frames, mut top) = (Vec::new(), 0.0);
    for lane in 0..n_lanes {
        let (head, padding) = if has_frames { (FRAME_HEAD, FRAME_PADDING) } else { (0.0, 0.0) };
        let in_lane = |column: &Vec<usize>| column.iter().copied().filter(|&idx| items[idx].lane == lane).collect();
        let order: Vec<Vec<usize>> = order.iter().map(in_lane).collect();
        let mut bottom: f64 = top + head;
        // Texts in the gaps need as much room as boxes where several edges leave for one column.
        for (idx, y) in level(&order, &items, sizes, &chains) {
            ys[idx] = top + head + y;
            bottom = bottom.max(ys[idx] + items[idx].below + padding);
        }
        for (chain, edge) in chains.iter().zip(&sizes.edges).filter(|(chain, _)| has_frames && chain.len() == 2) {
            if chain.iter().all(|&idx| items[idx].lane == lane) {
                // A line of the text stands above the arrow.
                bottom = bottom.max(ys[chain[0]].max(ys[chain[1]]) + edge.2[1] - 14.0 + padding);
            }
        }
        frames.push([top, bottom]);
        top = bottom + if has_frames { gap_below(lane, &crossings, sizes) } else { 0.0 };
    }
    let xs = column_xs(&order, &items, sizes, &chains);
    let height = (0..items.len()).map(|idx| ys[idx] + items[idx].below).fold(0.0, f64::max);
    let (last_x, last_width) = xs.last().copied().unwrap_or((0.0, 0.0));

    let at = |idx: usize| [xs[items[idx].column].0, ys[idx]];
    let nodes: Vec<[f64; 2]> = (0..sizes.nodes.len()).map(at).collect();
    let mut edges: Vec<EdgePath> = (chains.iter().enumerate())
        .map(|(edge_idx, chain)| {
            let (from, to, _) = sizes.edges[edge_idx];
            let side = |node: usize, is_out: bool| end_offset(edge_idx, node, is_out, sizes, &chains, &ys);
            let start = [nodes[from][0] + sizes.nodes[from][0] / 2.0, nodes[from][1] + side(from, true)];
            let end = [nodes[to][0] - sizes.nodes[to][0] / 2.0, nodes[to][1] + side(to, false)];
            let through = chain[1..chain.len() - 1].iter().map(|&idx| {
                let ([x, y], half) = (at(idx), xs[items[idx].column].1 / 2.0);
                [[x - half, y], [x + half, y]]
            });
            let pieces: Vec<_> = [[start, start]].into_iter().chain(through).chain([[end, end]]).collect();
            let label = label_place(&pieces, from, to, &sizes.edges);
            EdgePath { pieces, label, is_beside: false }
        })
        .collect();
    place_texts(&mut edges, &crossings, sizes, &frames);
    keep_labels_apart(&mut edges, sizes, &columns);
    let label_bottom = edges.iter().zip(&sizes.edges).map(|(edge, size)| edge.label[1] + size.2[1] / 2.0);
    frames.truncate(sizes.n_frames);
    let bottom = label_bottom.chain(frames.iter().map(|frame| frame[1])).fold(height, f64::max);
    let beside = edges.iter().zip(&sizes.edges).filter(|(edge, _)| edge.is_beside);
    let width = beside.map(|(edge, size)| edge.label[0] + size.2[0] / 2.0).fold(last_x + last_width / 2.0, f64::max);
    Layout { width, height: bottom, nodes, edges, frames }
}

fn columns_by_longest_path(n_nodes: usize, edges: &[(usize, usize, [f64; 2])]) -> Vec<usize> {
    let mut columns = vec![0; n_nodes];
    // A longest path has fewer steps than there are nodes; with a cycle this ends all the same.
    for _ in 0..n_nodes {
        for &(from, to, _) in edges {
            if columns[to] <= columns[from] && columns[from] + 1 < n_nodes {
                columns[to] = columns[from] + 1;
            }
        }
    }
    columns
}

/// The items that an edge goes through, its nodes included; those between are made.
fn chain_of(
    &(from, to, [width, height]): &(usize, usize, [f64; 2]),
    sizes: &Sizes,
    columns: &[usize],
    items: &mut Vec<Item>,
) -> Vec<usize> {
    let mut chain = vec![from];
    let lane = passing_lane((from, to), sizes, columns);
    let is_crossing = sizes.lanes[from] != sizes.lanes[to];
    for column in columns[from] + 1..columns[to] {
        // Its text stands above the line, where it first passes by something.
        let has_label = column == columns[from] + 1 && !is_crossing;
        let (above, width) = if has_label { (height + 4.0, width) } else { (4.0, 0.0) };
        items.push(Item {
            column,
            lane,
            is_node: false,
            above,
            below: 6.0,
            width,
            left: Vec::new(),
            right: Vec::new(),
        });
        chain.push(items.len() - 1);
    }
    chain.push(to);
    for pair in chain.windows(2) {
        items[pair[0]].right.push(pair[1]);
        items[pair[1]].left.push(pair[0]);
    }
    chain
}

fn order_by_barycentre(order: &mut [Vec<usize>], items: &[Item]) {
    order.iter_mut().for_each(|column| column.sort_by_key(|&idx| items[idx].lane));
    let mut best = order.to_vec();
    let mut n_least = n_crossings(&best, items);
    for sweep in 0..N_SWEEPS {
        let rightwards = sweep % 2 == 0;
        let mut column_idxs: Vec<usize> = (0..order.len()).collect();
        if !rightwards {
            column_idxs.reverse();
        }
        for column in column_idxs {
            let place = places(order, items.len());
            let barycentre = |idx: usize| {
                let neighbours = if rightwards { &items[idx].left } else { &items[idx].right };
                if neighbours.is_empty() {
                    return place[idx];
                }
                neighbours.iter().map(|&other| place[other]).sum::<f64>() / neighbours.len() as f64
            };
            order[column].sort_by(|&a, &b| {
                (items[a].lane.cmp(&items[b].lane)).then_with(|| barycentre(a).total_cmp(&barycentre(b)))
            });
        }
        let n = n_crossings(order, items);
        if n < n_least {
            (n_least, best) = (n, order.to_vec());
        }
    }
    order.clone_from_slice(&best);
}

/// Where each item is in its column, from -1 to 1, so that columns of different lengths compare.
fn places(order: &[Vec<usize>], n_items: usize) -> Vec<f64> {
    let mut places = vec![0.0; n_items];
    for column in order {
        for (place, &idx) in column.iter().enumerate() {
            places[idx] = (2 * place + 1) as f64 / column.len() as f64 - 1.0;
        }
    }
    places
}

fn n_crossings(order: &[Vec<usize>], items: &[Item]) -> usize {
    let place = places(order, items.len());
    let mut n = 0;
    for column in order {
        let edges: Vec<(f64, f64)> = column
            .iter()
            .flat_map(|&idx| items[idx].right.iter().map(move |&to| (idx, to)))
            .map(|(from, to)| (place[from], place[to]))
            .collect();
        for (idx, a) in edges.iter().enumerate() {
            n += edges[idx + 1..].iter().filter(|b| (a.0 - b.0) * (a.1 - b.1) < 0.0).count();
        }
    }
    n
}

/// The y of each item of a lane, from its upper end.
fn level(order: &[Vec<usize>], items: &[Item], sizes: &Sizes, chains: &[Vec<usize>]) -> Vec<(usize, f64)> {
    let gap = |upper: usize, lower: usize| {
        let room = |item: usize| label_room(item, items, sizes, chains);
        let labels = room(upper).max(room(lower));
        (items[upper].below + NODE_GAP + items[lower].above).max(labels)
    };
    let mut ys = vec![0.0; items.len()];
    for column in order {
        for pair in column.windows(2) {
            ys[pair[1]] = ys[pair[0]] + gap(pair[0], pair[1]);
        }
    }
    for sweep in 0..N_LEVELLINGS {
        let rightwards = sweep % 2 == 0;
        for step in 0..order.len() {
            let column = &order[if rightwards { step } else { order.len() - 1 - step }];
            let wished: Vec<f64> = column
                .iter()
                .map(|&idx| {
                    let (near, far) = (&items[idx].left, &items[idx].right);
                    // The last sweeps look both ways.
                    let neighbours: Vec<usize> = match (rightwards, sweep >= N_LEVELLINGS / 2) {
                        (_, true) => near.iter().chain(far).copied().collect(),
                        (true, false) => near.clone(),
                        (false, false) => far.clone(),
                    };
                    let is_here = |other: &usize| items[*other].lane == items[idx].lane;
                    let neighbours: Vec<usize> = neighbours.into_iter().filter(is_here).collect();
                    if neighbours.is_empty() {
                        return ys[idx];
                    }
                    let weigh = |&other: &usize| weight(&items[idx], &items[other]);
                    let total: f64 = neighbours.iter().map(weigh).sum();
                    neighbours.iter().map(|other| ys[*other] * weigh(other)).sum::<f64>() / total
                })
                .collect();
            let gaps: Vec<f64> = column.windows(2).map(|pair| gap(pair[0], pair[1])).collect();
            for (&idx, y) in column.iter().zip(nearest_with_gaps(&wished, &gaps)) {
                ys[idx] = y;
            }
        }
    }
    let here = || order.iter().flatten().copied();
    let top = here().map(|idx| ys[idx] - items[idx].above).fold(f64::INFINITY, f64::min);
    here().map(|idx| (idx, ys[idx] - top)).collect()
}

/// How much two neighbours want to be level: what passes by is straight, and bends rather at its ends than to move boxes.
fn weight(a: &Item, b: &Item) -> f64 {
    match (a.is_node, b.is_node) {
        (true, true) => 2.0,
        (false, false) => 8.0,
        _ => 0.02,
    }
}

/// How far apart neighbours must be for the texts of edges that come to or leave from them alone.
fn label_room(item: usize, items: &[Item], sizes: &Sizes, chains: &[Vec<usize>]) -> f64 {
    let is_here = |chain: &[usize]| chain.iter().all(|&other| items[other].lane == items[item].lane);
    let ends = chains.iter().zip(&sizes.edges);
    let ends = ends.filter(|(chain, _)| chain.len() == 2 && chain.contains(&item) && is_here(chain));
    ends.map(|(_, edge)| edge.2[1] + 8.0).fold(0.0, f64::max)
}

/// The numbers nearest to those wished for, in least squares, that keep these gaps: pool adjacent violators.
fn nearest_with_gaps(wished: &[f64], gaps: &[f64]) -> Vec<f64> {
    let mut offsets = vec![0.0];
    offsets.extend(gaps.iter().scan(0.0, |sum, gap| {
        *sum += gap;
        Some(*sum)
    }));
    // Mean and number of each pool.
    let mut pools: Vec<(f64, usize)> = Vec::new();
    for (wish, offset) in wished.iter().zip(&offsets) {
        pools.push((wish - offset, 1));
        while let [.., (before, n_before), (last, n_last)] = pools[..]
            && before > last
        {
            let n = n_before + n_last;
            pools.truncate(pools.len() - 2);
            pools.push(((before * n_before as f64 + last * n_last as f64) / n as f64, n));
        }
    }
    let means = pools.iter().flat_map(|&(mean, n)| std::iter::repeat_n(mean, n));
    means.zip(&offsets).map(|(mean, offset)| mean + offset).collect()
}

/// Centre and width of each column.
fn column_xs(order: &[Vec<usize>], items: &[Item], sizes: &Sizes, chains: &[Vec<usize>]) -> Vec<(f64, f64)> {
    let mut xs = Vec::new();
    let mut right = 0.0;
    for (column, idxs) in order.iter().enumerate() {
        let width = idxs.iter().map(|&idx| items[idx].width).fold(0.0, f64::max);
        if column > 0 {
            let here = chains.iter().zip(&sizes.edges);
            let labels = here.filter(|(chain, _)| chain.len() == 2 && items[chain[1]].column == column);
            let widest = labels.map(|(_, edge)| edge.2[0] + 2.0 * LABEL_GAP).fold(COLUMN_GAP, f64::max);
            right += widest;
        }
        xs.push((right + width / 2.0, width));
        right += width;
    }
    xs
}

/// How far from the middle of a box's side an edge ends: they stand in the order of where they come from or go to.
fn end_offset(edge: usize, node: usize, is_out: bool, sizes: &Sizes, chains: &[Vec<usize>], ys: &[f64]) -> f64 {
    let next = |chain: &[usize]| if is_out { chain[1] } else { chain[chain.len() - 2] };
    let mut ends: Vec<usize> = (0..chains.len())
        .filter(|&other| if is_out { sizes.edges[other].0 == node } else { sizes.edges[other].1 == node })
        .collect();
    ends.sort_by(|&a, &b| ys[next(&chains[a])].total_cmp(&ys[next(&chains[b])]));
    let place = ends.iter().position(|&other| other == edge).unwrap_or(0) as f64;
    let gap = END_GAP.min(sizes.nodes[node][1] * 0.7 / ends.len() as f64);
    (place - (ends.len() - 1) as f64 / 2.0) * gap
}

/// In the middle of a short edge, nearer to that end that it has to itself; above the first level piece of a long one.
fn label_place(pieces: &[[[f64; 2]; 2]], from: usize, to: usize, edges: &[(usize, usize, [f64; 2])]) -> [f64; 2] {
    if let [_, through, .., _] = pieces {
        return [(through[0][0] + through[1][0]) / 2.0, through[0][1]];
    }
    let n_out = edges.iter().filter(|edge| edge.0 == from).count();
    let n_in = edges.iter().filter(|edge| edge.1 == to).count();
    let t = match (n_out > 1, n_in > 1) {
        (true, false) => 0.72,
        (false, true) => 0.28,
        _ => 0.5,
    };
    let ([x0, y0], [x1, y1]) = (pieces[0][1], pieces[pieces.len() - 1][0]);
    // On the curve, whose handles are level and reach to the middle; the text's x stays in the middle of the gap.
    let rise: f64 = t * t * (3.0 - 2.0 * t);
    [(x0 + x1) / 2.0, y0 + (y1 - y0) * rise]
}

/// Pushes texts in one gap down until they no longer overlap.
fn keep_labels_apart(edges: &mut [EdgePath], sizes: &Sizes, columns: &[usize]) {
    let is_short = |edge: &EdgePath| edge.pieces.len() == 2 && !edge.is_beside;
    let mut by_height: Vec<usize> = (0..edges.len()).filter(|&idx| is_short(&edges[idx])).collect();
    by_height.sort_by(|&a, &b| edges[a].label[1].total_cmp(&edges[b].label[1]));
    for place in 1..by_height.len() {
        let idx = by_height[place];
        for &other in &by_height[..place] {
            let is_same_gap = columns[sizes.edges[other].1] == columns[sizes.edges[idx].1];
            let least = edges[other].label[1] + (sizes.edges[other].2[1] + sizes.edges[idx].2[1]) / 2.0 + 2.0;
            if is_same_gap && edges[idx].label[1] < least {
                edges[idx].label[1] = least;
            }
        }
    }
}
