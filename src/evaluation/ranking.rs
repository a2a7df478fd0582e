//! How well scores separate what is inside from what is outside, whatever the threshold.

/// Area under the receiver's operating curve: the chance that an inside score exceeds an outside one, ties half.
/// `None` if either side is empty.
pub fn roc_auc(inside: &[f32], outside: &[f32]) -> Option<f64> {
    if inside.is_empty() || outside.is_empty() {
        return None;
    }
    let mut outside = outside.to_vec();
    outside.sort_by(f32::total_cmp);
    let wins: f64 = inside
        .iter()
        .map(|score| {
            let below = outside.partition_point(|other| other < score);
            let not_above = outside.partition_point(|other| other <= score);
            (below + not_above) as f64 / 2.0
        })
        .sum();
    Some(wins / (inside.len() as f64 * outside.len() as f64))
}

/// Average precision: the sum over falling thresholds of precision times the gain in recall. Equal scores are one
/// threshold, so their order does not matter. `None` if nothing is inside.
pub fn average_precision(inside: &[f32], outside: &[f32]) -> Option<f64> {
    if inside.is_empty() {
        return None;
    }
    let mut scores: Vec<(f32, bool)> = inside
        .iter()
        .map(|&score| (score, true))
        .chain(outside.iter().map(|&score| (score, false)))
        .collect();
    scores.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (mut found, mut taken, mut sum) = (0usize, 0usize, 0.0);
    for tied in scores.chunk_by(|a, b| a.0 == b.0) {
        let gained = tied.iter().filter(|(_, is_inside)| *is_inside).count();
        found += gained;
        taken += tied.len();
        sum += gained as f64 * found as f64 / taken as f64;
    }
    Some(sum / inside.len() as f64)
}
