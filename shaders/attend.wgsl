// Twin of src/stages/attend.rs, as far as the evidence map.

const BLOCK: u32 = 4u;

/// The fifth of nine.
fn median_of_nine(values: array<f32, 9>) -> f32 {
    var rest = values;
    for (var i = 0u; i < 5u; i++) {
        for (var other = i + 1u; other < 9u; other++) {
            let low = min(rest[i], rest[other]);
            rest[other] = max(rest[i], rest[other]);
            rest[i] = low;
        }
    }
    return rest[4];
}
