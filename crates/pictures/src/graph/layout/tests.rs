//! Where boxes, arrows and frames go.

use super::*;

fn place(n_nodes: usize, edges: &[(usize, usize)]) -> Layout {
    let edges = edges.iter().map(|&(from, to)| (from, to, [80.0, 30.0])).collect();
    layout(&Sizes { nodes: vec![[100.0, 40.0]; n_nodes], edges, lanes: vec![0; n_nodes], n_frames: 0 })
}

/// As [`place`], with each node in a framed lane.
fn place_in(lanes: &[usize], edges: &[(usize, usize)]) -> Layout {
    let edges = edges.iter().map(|&(from, to)| (from, to, [80.0, 30.0])).collect();
    let n_frames = lanes.iter().max().map_or(0, |lane| lane + 1);
    layout(&Sizes { nodes: vec![[100.0, 40.0]; lanes.len()], edges, lanes: lanes.to_vec(), n_frames })
}

#[test]
fn frames_hold_their_nodes_and_texts_stand_between_them() {
    // A robot's source, contacts and arbiter, with the brain's histogram and classifier between them.
    let found = place_in(&[0, 0, 1, 1, 0], &[(0, 1), (1, 2), (2, 3), (3, 4)]);
    let ys: Vec<f64> = found.nodes.iter().map(|node| node[1]).collect();
    assert!(ys[0] == ys[1] && ys[1] == ys[4] && ys[2] == ys[3] && ys[0] < ys[2], "{found:?}");
    let [robot, brain] = found.frames[..] else { panic!("two frames: {found:?}") };
    assert_eq!(robot[0], 0.0);
    for (node, lane) in found.nodes.iter().zip([robot, robot, brain, brain, robot]) {
        assert!(lane[0] <= node[1] - 20.0 && node[1] + 20.0 <= lane[1], "{found:?}");
    }
    let beside: Vec<bool> = found.edges.iter().map(|edge| edge.is_beside).collect();
    assert_eq!(beside, [false, true, false, true]);
    for edge in found.edges.iter().filter(|edge| edge.is_beside) {
        assert!(robot[1] <= edge.label[1] - 15.0 && edge.label[1] + 15.0 <= brain[0], "{found:?}");
    }
    assert_eq!(found.height, brain[1]);
}

#[test]
fn texts_between_the_same_frames_do_not_overlap() {
    let found = place_in(&[0, 0, 1, 1, 2], &[(0, 2), (0, 3), (1, 2), (1, 3), (0, 4), (2, 4)]);
    for (a, first) in found.edges.iter().enumerate() {
        for other in &found.edges[..a] {
            let [dx, dy] = [0, 1].map(|axis| (first.label[axis] - other.label[axis]).abs());
            assert!(dx >= 80.0 || dy >= 30.0, "{:?} {:?}", first.label, other.label);
        }
        assert!(first.label[0] + 40.0 <= found.width, "{found:?}");
    }
    for pair in found.frames.windows(2) {
        assert!(pair[0][1] < pair[1][0], "{found:?}");
    }
}

#[test]
fn an_edge_between_lanes_passes_by_where_there_is_room() {
    // The brain's three nodes are in the way of what goes from its first one to the robot's last.
    let found = place_in(&[1, 1, 1, 0], &[(0, 1), (1, 2), (2, 3), (0, 3)]);
    let passing = &found.edges[3].pieces;
    assert!(passing[1][0][1] < found.frames[0][1], "above the brain's frame: {found:?}");
    assert_eq!(passing[1][0][1], passing[2][0][1]);
}

#[test]
fn a_chain_is_level() {
    let found = place(3, &[(0, 1), (1, 2)]);
    // A box, the text between its gaps, a box.
    let step = 100.0 + 80.0 + 2.0 * LABEL_GAP;
    assert_eq!(found.nodes, [[50.0, 20.0], [50.0 + step, 20.0], [50.0 + 2.0 * step, 20.0]]);
    assert_eq!((found.width, found.height), (100.0 + 2.0 * step, 40.0));
    assert_eq!(found.edges[0].label, [50.0 + step / 2.0, 20.0]);
    assert_eq!(found.edges[1].pieces, [[[50.0 + step + 50.0, 20.0]; 2], [[2.0 * step, 20.0]; 2]]);
}

#[test]
fn a_diamond_is_symmetrical() {
    let found = place(4, &[(0, 1), (0, 2), (1, 3), (2, 3)]);
    let [source, upper, lower, sink] = found.nodes[..] else { panic!("four nodes") };
    assert!((source[1] - sink[1]).abs() < 1e-6 && (upper[1] + lower[1] - 2.0 * source[1]).abs() < 1e-6, "{found:?}");
    assert_eq!(lower[1] - upper[1], 40.0 + NODE_GAP);
}

#[test]
fn crossings_that_need_not_be_are_not() {
    // Two chains whose second halves are named the other way round.
    let found = place(4, &[(0, 3), (1, 2)]);
    assert!(found.nodes[3][1] < found.nodes[2][1], "{found:?}");
    assert_eq!(found.nodes[0][1], found.nodes[3][1]);
}

#[test]
fn a_long_edge_passes_by_the_boxes_between() {
    let found = place(3, &[(0, 1), (1, 2), (0, 2)]);
    let passing = found.edges[2].pieces[1];
    assert_eq!(found.edges[2].pieces.len(), 3);
    assert!((passing[0][1] - found.nodes[1][1]).abs() >= 20.0 + NODE_GAP, "{found:?}");
}

#[test]
fn no_two_boxes_and_no_two_texts_overlap() {
    // Sixteen nodes, each of which reads two or three of those before it.
    let edges: Vec<(usize, usize)> =
        (1..16).flat_map(|to| [(to - 1) / 2, (to * 7) % to].map(|from| (from, to))).collect();
    let found = place(16, &edges);
    for a in 0..16 {
        for b in 0..a {
            let [dx, dy] = [0, 1].map(|axis| (found.nodes[a][axis] - found.nodes[b][axis]).abs());
            assert!(dx >= 100.0 || dy >= 40.0 - 1e-6, "{a} and {b}: {:?}", found.nodes);
        }
    }
    for (a, first) in found.edges.iter().enumerate() {
        for other in found.edges[..a].iter().filter(|other| other.pieces.len() == 2 && first.pieces.len() == 2) {
            let [dx, dy] = [0, 1].map(|axis| (first.label[axis] - other.label[axis]).abs());
            assert!(dx >= 80.0 || dy >= 30.0 - 1e-6, "{:?} {:?}", first.label, other.label);
        }
    }
    assert!(
        found.nodes.iter().all(|[x, y]| *x >= 50.0 && *y >= 20.0 && *x <= found.width - 50.0 && *y <= found.height)
    );
}

#[test]
fn nothing_and_a_cycle_are_drawn_too() {
    assert_eq!((place(0, &[]).width, place(0, &[]).height), (0.0, 0.0));
    assert_eq!(place(2, &[(0, 1), (1, 0)]).nodes.len(), 2);
    assert_eq!(place(1, &[(0, 0)]).edges.len(), 1);
}

#[test]
fn gaps_are_kept_at_the_least_cost() {
    assert_eq!(nearest_with_gaps(&[0.0, 10.0], &[5.0]), [0.0, 10.0]);
    assert_eq!(nearest_with_gaps(&[4.0, 4.0, 4.0], &[2.0, 2.0]), [2.0, 4.0, 6.0]);
    assert_eq!(nearest_with_gaps(&[0.0, 9.0, 9.0], &[2.0, 4.0]), [0.0, 7.0, 11.0]);
}
