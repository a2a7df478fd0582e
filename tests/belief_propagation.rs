//! Eight bits are enough: the vectorised, threaded, cache-blocked propagation over bytes believes exactly what
//! Felzenszwalb and Huttenlocher's algorithm written down plainly in 32 bits believes.

use proptest::{prelude::*, test_runner::Config};
use surprised::{
    isa::Isa,
    stages::depth::{BeliefPropagation, Contrast, PropagationSettings, Smoothness},
};

/// One level of the reference: costs `[y][x][label]`, messages received `[neighbour][y][x][label]`.
struct Grid {
    width: usize,
    height: usize,
    labels: usize,
    costs: Vec<i32>,
    received: [Vec<i32>; 4],
}

/// dx, dy and the index of the opposite direction.
const NEIGHBOURS: [(isize, isize, usize); 4] = [(0, -1, 1), (0, 1, 0), (-1, 0, 3), (1, 0, 2)];

impl Grid {
    fn new(width: usize, height: usize, labels: usize, costs: Vec<i32>) -> Self {
        let received = std::array::from_fn(|_| vec![0; costs.len()]);
        Self {
            width,
            height,
            labels,
            costs,
            received,
        }
    }

    fn at(&self, x: usize, y: usize) -> usize {
        (y * self.width + x) * self.labels
    }

    fn neighbour(&self, x: usize, y: usize, k: usize) -> Option<(usize, usize)> {
        let nx = x.checked_add_signed(NEIGHBOURS[k].0)?;
        let ny = y.checked_add_signed(NEIGHBOURS[k].1)?;
        (nx < self.width && ny < self.height).then_some((nx, ny))
    }

    fn coarser(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut costs = vec![0; width * height * self.labels];
        for y in 0..self.height {
            for x in 0..self.width {
                for label in 0..self.labels {
                    costs[(y / 2 * width + x / 2) * self.labels + label] +=
                        self.costs[self.at(x, y) + label];
                }
            }
        }
        Self::new(width, height, self.labels, costs)
    }

    fn start_from(&mut self, coarser: &Self) {
        for k in 0..4 {
            for y in 0..self.height {
                for x in 0..self.width {
                    let (to, from) = (self.at(x, y), coarser.at(x / 2, y / 2));
                    let message = &coarser.received[k][from..from + self.labels];
                    self.received[k][to..to + self.labels].copy_from_slice(message);
                }
            }
        }
    }

    #[allow(
        clippy::needless_range_loop,
        reason = "a direction indexes three tables"
    )]
    fn iterate(
        &mut self,
        iteration: usize,
        smoothness: &dyn Fn((usize, usize), (usize, usize)) -> Smoothness,
    ) {
        for y in 0..self.height {
            for x in (0..self.width).filter(|x| (x + y) % 2 == iteration % 2) {
                for k in 0..4 {
                    let Some(to) = self.neighbour(x, y, k) else {
                        continue;
                    };
                    let Smoothness { step, truncation } = smoothness((x, y), to);
                    let at = self.at(x, y);
                    let h: Vec<i32> = (0..self.labels)
                        .map(|l| {
                            self.costs[at + l]
                                + (0..4)
                                    .filter(|j| *j != k)
                                    .map(|j| self.received[j][at + l])
                                    .sum::<i32>()
                        })
                        .collect();
                    let least = *h.iter().min().unwrap();
                    let to = self.at(to.0, to.1);
                    for l in 0..self.labels {
                        let near = (0..self.labels)
                            .map(|other| h[other] + i32::from(step) * l.abs_diff(other) as i32)
                            .min()
                            .unwrap();
                        self.received[NEIGHBOURS[k].2][to + l] =
                            near.min(least + i32::from(truncation)) - least;
                    }
                }
            }
        }
    }

    fn labels(&self) -> Vec<u8> {
        let pixels = (0..self.height).flat_map(|y| (0..self.width).map(move |x| (x, y)));
        pixels
            .map(|(x, y)| {
                let at = self.at(x, y);
                let belief = |l: &usize| {
                    self.costs[at + l] + self.received.iter().map(|m| m[at + l]).sum::<i32>()
                };
                (0..self.labels).min_by_key(belief).unwrap() as u8
            })
            .collect()
    }
}

fn reference(settings: &PropagationSettings, finest: Grid, contrasts: &[Contrast]) -> Vec<u8> {
    let mut levels = vec![finest];
    while levels.len() < settings.levels
        && levels
            .last()
            .unwrap()
            .width
            .max(levels.last().unwrap().height)
            > 1
    {
        levels.push(levels.last().unwrap().coarser());
    }
    for at in (0..levels.len()).rev() {
        let (finer, coarser) = levels.split_at_mut(at + 1);
        let level = &mut finer[at];
        if let Some(coarser) = coarser.first() {
            level.start_from(coarser);
        }
        let width = level.width;
        let contrast = &contrasts[at];
        let smoothness = |a: (usize, usize), b: (usize, usize)| {
            let first = a.min(b);
            let differ = if a.1 == b.1 {
                &contrast.right
            } else {
                &contrast.below
            };
            // The upper or left one of the two; both orders agree, as one coordinate is equal.
            if differ[first.1 * width + first.0] > 0 {
                settings.across_contrast
            } else {
                settings.smooth
            }
        };
        for iteration in 0..settings.iterations_at(at) {
            level.iterate(iteration, &smoothness);
        }
    }
    levels[0].labels()
}

#[derive(Debug, Clone)]
struct Case {
    width: usize,
    height: usize,
    labels: usize,
    settings: PropagationSettings,
    highest_cost: u8,
    seed: u64,
}

/// Cheap and reproducible: the values matter little, only that they are all over the range.
fn random_bytes(seed: u64) -> impl FnMut() -> u8 {
    let mut state = seed | 1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 32) as u8
    }
}

fn smoothness() -> impl Strategy<Value = Smoothness> {
    (1_u8..=8, 1..=Smoothness::HIGHEST_TRUNCATION)
        .prop_map(|(step, truncation)| Smoothness { step, truncation })
}

fn case(
    width: impl Strategy<Value = usize>,
    height: impl Strategy<Value = usize>,
) -> impl Strategy<Value = Case> {
    let settings = (
        smoothness(),
        smoothness(),
        1..=5_usize,
        2..=6_usize,
        2..=7_usize,
    )
        .prop_map(
            |(smooth, across_contrast, levels, iterations, coarse_iterations)| {
                PropagationSettings {
                    smooth,
                    across_contrast,
                    levels,
                    iterations,
                    coarse_iterations,
                }
            },
        );
    let highest_cost = prop_oneof![1_u8..40, Just(255)];
    (
        width,
        height,
        2..=20_usize,
        settings,
        highest_cost,
        any::<u64>(),
    )
        .prop_map(
            |(width, height, labels, settings, highest_cost, seed)| Case {
                width,
                height,
                labels,
                settings,
                highest_cost,
                seed,
            },
        )
}

fn believes_as_the_reference(case: &Case) {
    let Case {
        width,
        height,
        labels,
        settings,
        highest_cost,
        seed,
    } = *case;
    let mut random = random_bytes(seed);
    let costs: Vec<u8> = (0..width * height * labels)
        .map(|_| (u16::from(random()) * u16::from(highest_cost) / 255) as u8)
        .collect();
    let contrasts: Vec<Contrast> = (0..settings.levels)
        .map(|level| {
            let pixels = width.div_ceil(1 << level) * height.div_ceil(1 << level);
            let mut edges = || (0..pixels).map(|_| random() & 1).collect();
            Contrast {
                right: edges(),
                below: edges(),
            }
        })
        .collect();
    let finest = Grid::new(
        width,
        height,
        labels,
        costs.iter().map(|c| i32::from(*c)).collect(),
    );
    let expected = reference(&settings, finest, &contrasts);
    for isa in Isa::available() {
        for threads in [1, 2, 3] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let mut propagation = BeliefPropagation::new(settings, width, height, labels, isa);
            // Twice: nothing of a solved problem may leak into the next.
            for round in 0..2 {
                let beliefs = pool.install(|| {
                    propagation.fill(
                        highest_cost,
                        || (),
                        |(), y, row| {
                            for x in 0..width {
                                for label in 0..labels {
                                    row.set(x, label, costs[(y * width + x) * labels + label]);
                                }
                            }
                        },
                    );
                    propagation.set_contrasts(&contrasts);
                    propagation.solve().to_vec()
                });
                let got: Vec<u8> = beliefs.iter().map(|belief| belief.label).collect();
                assert_eq!(got, expected, "{isa:?}, {threads} threads, round {round}");
            }
        }
    }
}

proptest! {
    #![proptest_config(Config { cases: 48, failure_persistence: None, ..Config::default() })]

    #[test]
    fn bytes_believe_what_32_bits_believe(case in case(1..=45_usize, 1..=60_usize)) {
        believes_as_the_reference(&case);
    }
}

proptest! {
    #![proptest_config(Config { cases: 6, failure_persistence: None, ..Config::default() })]

    #[test]
    fn rows_longer_than_a_vector_believe_what_32_bits_believe(case in case(60..=300_usize, 30..=40_usize)) {
        believes_as_the_reference(&case);
    }
}
