//! Time capt and mvtable on one walk; README.md beside Cargo.toml says how to run it and what it prints.
#![feature(portable_simd)]

mod case;
mod heap;
mod side;

use case::{Case, morton_order};
use side::Side;
use std::io::Write;
use std::path::{Path, PathBuf};

#[global_allocator]
static HEAP: heap::Counting = heap::Counting;

const USAGE: &str = "usage: peers DIR DISTANCE [--loops N] [--per-pose OUT] [--turns]";

/// Cell widths tried for mvtable [m]; its documentation names 0.1 to 0.2 as usual, so both ends lie well outside.
const WIDTHS: [f32; 9] = [0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.8];

/// Loops that choose among settings; what is reported is timed again afterwards.
const TRIAL_LOOPS: usize = 2;

struct Options {
    folder: PathBuf,
    distance: f32,
    loops: usize,
    per_pose: Option<PathBuf>,
    turns: bool,
}

fn options(mut words: impl Iterator<Item = String>) -> Result<Options, String> {
    let mut plain = vec![];
    let (mut loops, mut per_pose, mut turns) = (7, None, false);
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or(format!("{word} needs a value; {USAGE}"));
        match word.as_str() {
            "--loops" => loops = value()?.parse().map_err(|e| format!("--loops: {e}"))?,
            "--per-pose" => per_pose = Some(PathBuf::from(value()?)),
            "--turns" => turns = true,
            _ if word.starts_with("--") => return Err(format!("unknown option {word}; {USAGE}")),
            _ => plain.push(word),
        }
    }
    let [folder, distance] = plain.try_into().map_err(|_| USAGE.to_string())?;
    let distance: f32 = distance.parse().map_err(|e| format!("DISTANCE {distance}: {e}"))?;
    if !(distance.is_finite() && distance > 0.0) || loops == 0 {
        return Err(format!("DISTANCE must be above 0 and --loops at least 1; {USAGE}"));
    }
    Ok(Options { folder: folder.into(), distance, loops, per_pose, turns })
}

/// Keep `side` if it is the fastest of its name so far.
fn contend(best: &mut Vec<(f64, Side)>, side: Side, case: &Case) {
    let entry = best.iter_mut().find(|(_, other)| other.name == side.name);
    // A setting twice as slow in its first loop does not catch up in the next ones.
    let first = side.time(&case.poses);
    let hopeless = entry.as_ref().is_some_and(|(time, _)| first > 2.0 * time);
    let loops = if hopeless { 0 } else { TRIAL_LOOPS };
    let time = (0..loops).map(|_| side.time(&case.poses)).fold(first, f64::min);
    eprintln!("{:15} lanes {:2} {:6} {:?}: {time:.2} us", side.name, side.lanes, side.order, side.width);
    match entry {
        Some(entry) if time < entry.0 => *entry = (time, side),
        Some(_) => {}
        None => best.push((time, side)),
    }
}

/// Every setting of every peer on this case; the fastest of each name.
fn best_sides(case: &Case, r: f32) -> Vec<Side> {
    let sorted = morton_order(&case.avatar);
    let orders = [("given", &case.avatar[..]), ("morton", &sorted[..])];
    let mut best = vec![];
    // A tree built for n lanes pads each leaf's copies to n, so each lane count has a tree of its own.
    for lanes in [1, 8, 16, 32, 64] {
        let built = side::build_capt(&case.scene, r, lanes);
        for order in orders {
            let side = match lanes {
                1 => Side::capt::<1>("capt_scalar", &built, order, r),
                8 => Side::capt::<8>("capt_simd", &built, order, r),
                16 => Side::capt::<16>("capt_simd", &built, order, r),
                32 => Side::capt::<32>("capt_simd", &built, order, r),
                _ => Side::capt::<64>("capt_simd", &built, order, r),
            };
            contend(&mut best, side, case);
            // 16 float32 fill the widest register there is; shown beside the best of all.
            if lanes == 16 {
                contend(&mut best, Side::capt::<16>("capt_simd16", &built, order, r), case);
            }
        }
    }
    for width in WIDTHS {
        let built = side::build_mvt(&case.scene, width);
        for order in orders {
            contend(&mut best, Side::mvt::<1>("mvtable_scalar", &built, order, r), case);
            contend(&mut best, Side::mvt::<4>("mvtable_simd", &built, order, r), case);
            contend(&mut best, Side::mvt::<8>("mvtable_simd", &built, order, r), case);
            contend(&mut best, Side::mvt::<16>("mvtable_simd", &built, order, r), case);
        }
    }
    best.into_iter().map(|(_, side)| side).collect()
}

fn median(sorted: &[f64]) -> f64 {
    (sorted[(sorted.len() - 1) / 2] + sorted[sorted.len() / 2]) / 2.0
}

/// Write the verdicts and, where asked, the times of each pose; give the side's line of the report.
fn report(side: &Side, case: &Case, options: &Options, times: &[f64]) -> Result<String, String> {
    let name = side.name;
    let write = |path: PathBuf, bytes: &[u8]| {
        std::fs::write(&path, bytes).map_err(|e| format!("{}: {e}", path.display()))
    };
    let verdicts = side.verdicts(&case.poses);
    write(options.folder.join(format!("{name}.verdicts.u8")), &verdicts)?;
    if let Some(out) = &options.per_pose {
        std::fs::create_dir_all(out).map_err(|e| format!("{}: {e}", out.display()))?;
        let each = side.time_each(&case.poses, options.loops);
        let bytes: Vec<u8> = each.iter().flat_map(|t| t.to_le_bytes()).collect();
        write(out.join(format!("{name}.us.f32")), &bytes)?;
    }
    Ok(format!(
        "\"{name}\": {{\"lanes\": {}, \"avatar_order\": \"{}\", \"cell_width\": {}, \"build_s\": {:.4}, \
         \"bytes\": {}, \"bytes_by_crate\": {}, \"us_best\": {:.3}, \"us_median\": {:.3}, \"colliding\": {}}}",
        side.lanes,
        side.order,
        side.width.map_or("null".into(), |w| w.to_string()),
        side.build_seconds,
        side.heap_bytes,
        side.own_bytes,
        times[0],
        median(times),
        verdicts.iter().filter(|&&v| v == 1).count()
    ))
}

/// Answer each line on standard input, `SIDE` or `SIDE FILE`, with one timed loop of that side, after one that warms
/// its caches. FILE has other poses, as poses.f32 has them; their verdicts go to `FILE.SIDE.u8`.
fn take_turns(sides: &[Side], case: &Case) -> Result<(), String> {
    for line in std::io::stdin().lines() {
        let line = line.map_err(|e| format!("standard input: {e}"))?;
        let (name, file) = line.trim().split_once(' ').unwrap_or((line.trim(), ""));
        let side = sides.iter().find(|s| s.name == name).ok_or(format!("no side is named {name:?}"))?;
        let given = if file.is_empty() { None } else { Some(case::read_poses(Path::new(file))?) };
        let poses = given.as_ref().unwrap_or(&case.poses);
        if given.is_some() {
            let target = format!("{file}.{name}.u8");
            std::fs::write(&target, side.verdicts(poses)).map_err(|e| format!("{target}: {e}"))?;
        }
        side.time(poses);
        println!("{:.4}", side.time(poses));
        std::io::stdout().flush().map_err(|e| format!("standard output: {e}"))?;
    }
    Ok(())
}

fn run() -> Result<(), String> {
    let options = options(std::env::args().skip(1))?;
    let case = Case::read(&options.folder)?;
    let sides = best_sides(&case, options.distance);
    // The sides in turn within each loop, so that a slow moment of the machine falls on all of them.
    let mut times = vec![vec![]; sides.len()];
    for _ in 0..options.loops {
        for (side, times) in sides.iter().zip(&mut times) {
            side.time(&case.poses);
            times.push(side.time(&case.poses));
        }
    }
    let mut lines = vec![];
    for (side, times) in sides.iter().zip(&mut times) {
        times.sort_by(f64::total_cmp);
        lines.push(report(side, &case, &options, times)?);
    }
    println!(
        "{{\"points\": {}, \"avatar\": {}, \"poses\": {}, \"distance\": {}, \"sides\": {{{}}}}}",
        case.scene.len(),
        case.avatar.len(),
        case.poses.len(),
        options.distance,
        lines.join(", ")
    );
    std::io::stdout().flush().map_err(|e| format!("standard output: {e}"))?;
    if options.turns { take_turns(&sides, &case) } else { Ok(()) }
}

fn main() -> std::process::ExitCode {
    match run() {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("peers: {message}");
            std::process::ExitCode::from(2)
        }
    }
}
