//! Side images get the middle one's exposure before they are compared.
//! In: luminance of the two. Out: a table of grey levels. Open in the paper: all of it.

/// A table that gives a side image the middle one's exposure: a line through the tenth, fiftieth and ninetieth hundredth of
/// both distributions of luminance. Differences that parallax alone explains change nothing.
pub(super) fn match_exposure(middle: &[u8], side: &[u8]) -> [u8; 256] {
    let same = std::array::from_fn(|value| value as u8);
    let quantiles = |image: &[u8]| {
        let mut count = [0_usize; 256];
        for value in image {
            count[usize::from(*value)] += 1;
        }
        [0.1, 0.5, 0.9].map(|part| {
            let mut left = (part * image.len() as f64) as usize;
            let value = count.iter().position(|n| {
                let found = left < *n;
                left = left.saturating_sub(*n);
                found
            });
            value.unwrap_or(255) as f64
        })
    };
    let (middle, side) = (quantiles(middle), quantiles(side));
    const UNNOTICED: f64 = 2.5;
    if middle
        .iter()
        .zip(&side)
        .all(|(m, s)| (m - s).abs() <= UNNOTICED)
        || side[2] - side[0] < 8.0
    {
        return same;
    }
    let gain = ((middle[2] - middle[0]) / (side[2] - side[0])).clamp(0.5, 2.0);
    let offset = (0..3).map(|i| middle[i] - gain * side[i]).sum::<f64>() / 3.0;
    std::array::from_fn(|value| (gain * value as f64 + offset).round().clamp(0.0, 255.0) as u8)
}
