// One thread a view: the estimate is accepted or not, and the views are placed before the camera that it tells of.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> level: Level;
@group(0) @binding(2) var<storage, read_write> estimate: Estimate;
@group(0) @binding(3) var<uniform> given_views: array<View, VIEWS_MAX>;
@group(0) @binding(4) var<storage, read_write> views: array<View, VIEWS_MAX>;

@compute @workgroup_size(16, 1, 1)
fn place(@builtin(local_invocation_index) thread: u32) {
    let found = estimate;
    let accepted = is_accepted(level, found);
    storageBarrier();
    if thread == 0u {
        estimate.accepted = u32(accepted);
    }
    if thread >= frame.view_count {
        return;
    }
    let given = given_views[thread];
    if accepted {
        views[thread] = seen_really(given, level, found);
    } else {
        views[thread] = given;
    }
}
