//! How long one thread takes to render what the three cameras see, 320x240 each: `cargo bench --bench render`.
//!
//! On a quiet Xeon with AVX-512: 81 ms with the table laid, 88 ms with a person reaching in, 30 ms for the
//! middle camera alone.

use criterion::{Criterion, criterion_group, criterion_main};
use surprised::simulation::script::{Script, Views};

fn render(criterion: &mut Criterion) {
    let script = Script::tabletop(1);
    let one_thread = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .expect("a thread");
    let mut group = criterion.benchmark_group("render");
    group.sample_size(20);
    // Frame 800: glass and cup stand there. Frame 675: the person is close.
    for (name, frame) in [("table", 799), ("person", 674)] {
        group.bench_function(format!("triple_{name}"), |bencher| {
            bencher.iter(|| one_thread.install(|| script.capture(0, frame, Views::Triple)));
        });
    }
    group.bench_function("middle_table", |bencher| {
        bencher.iter(|| one_thread.install(|| script.capture(0, 799, Views::Middle)));
    });
    group.finish();
}

criterion_group!(benches, render);
criterion_main!(benches);
