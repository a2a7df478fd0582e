//! ROC-AUC and average precision against values computed by hand.

use surprised::evaluation::ranking::{average_precision, roc_auc};

fn near(value: Option<f64>, expected: f64) {
    let value = value.expect("both sides have scores");
    assert!(
        (value - expected).abs() < 1e-12,
        "{value} is not {expected}"
    );
}

#[test]
fn auc_counts_the_pairs_in_the_right_order() {
    // 4 beats all three, 2 beats 1 and 0.5 but not 3: five pairs of six.
    near(roc_auc(&[4.0, 2.0], &[3.0, 1.0, 0.5]), 5.0 / 6.0);
    near(roc_auc(&[9.0], &[1.0]), 1.0);
    near(roc_auc(&[1.0], &[9.0]), 0.0);
}

#[test]
fn auc_counts_ties_half() {
    near(roc_auc(&[1.0, 1.0], &[1.0, 1.0]), 0.5);
    near(roc_auc(&[2.0], &[2.0, 1.0]), 0.75);
}

#[test]
fn average_precision_weighs_precision_by_gained_recall() {
    // Ranked in, out, in, out: 1/2 * 1/1 + 1/2 * 2/3.
    near(average_precision(&[4.0, 2.0], &[3.0, 1.0]), 5.0 / 6.0);
}

#[test]
fn average_precision_of_ties_does_not_depend_on_their_order() {
    // All four are one threshold: precision 1/2 at recall 1.
    near(average_precision(&[1.0, 1.0], &[1.0, 1.0]), 0.5);
    // 5 alone, then two tied, of which one is inside: 1/2 * 1 + 1/2 * 2/3.
    near(average_precision(&[5.0, 2.0], &[2.0]), 5.0 / 6.0);
}

#[test]
fn an_empty_side_has_no_value() {
    assert_eq!(roc_auc(&[], &[1.0]), None);
    assert_eq!(roc_auc(&[1.0], &[]), None);
    assert_eq!(average_precision(&[], &[1.0]), None);
}
