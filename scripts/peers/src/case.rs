//! One case: a scene, an avatar and the poses it is put in, all float32 in one local frame [m].

use std::path::Path;
use std::simd::Simd;

/// Row-major rotation (nine numbers), then the translation.
pub type Pose = [f32; 12];

/// What the folder held.
pub struct Case {
    pub scene: Vec<[f32; 3]>,
    pub avatar: Vec<[f32; 3]>,
    pub poses: Vec<Pose>,
}

impl Case {
    /// Read `scene.f32`, `avatar.f32` and `poses.f32` of `folder`, or say which one is not as it should be.
    pub fn read(folder: &Path) -> Result<Self, String> {
        Ok(Self {
            scene: rows(&folder.join("scene.f32"))?,
            avatar: rows(&folder.join("avatar.f32"))?,
            poses: read_poses(&folder.join("poses.f32"))?,
        })
    }
}

/// The poses of a file such as `poses.f32`.
pub fn read_poses(path: &Path) -> Result<Vec<Pose>, String> {
    rows(path)
}

fn rows<const K: usize>(path: &Path) -> Result<Vec<[f32; K]>, String> {
    let bytes = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
    if bytes.is_empty() || bytes.len() % (4 * K) != 0 {
        let found = bytes.len();
        return Err(format!("{}: {found} bytes, expected rows of {K} float32", path.display()));
    }
    let row = |b: &[u8]| std::array::from_fn(|k| f32::from_le_bytes(b[4 * k..4 * k + 4].try_into().unwrap()));
    let rows: Vec<[f32; K]> = bytes.chunks_exact(4 * K).map(row).collect();
    match rows.iter().position(|r| r.iter().any(|x| !x.is_finite())) {
        Some(i) => Err(format!("{}: row {i} holds a number that is not finite", path.display())),
        None => Ok(rows),
    }
}

/// The same points along a Morton curve, so that neighbours in the list are neighbours in space.
pub fn morton_order(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    let mut low = points[0];
    for p in points {
        for k in 0..3 {
            low[k] = low[k].min(p[k]);
        }
    }
    let code = |p: &[f32; 3]| {
        let cell = |k: usize| ((p[k] - low[k]) * 1000.0) as u64; // 1 mm; far below any spacing of an avatar
        (0..21).fold(0u64, |c, bit| (0..3).fold(c, |c, k| c | (cell(k) >> bit & 1) << (3 * bit + k)))
    };
    let mut sorted = points.to_vec();
    sorted.sort_by_cached_key(code);
    sorted
}

/// The avatar in groups of `L` points, one vector an axis; the last group repeats its last point.
pub fn groups<const L: usize>(points: &[[f32; 3]]) -> Vec<[Simd<f32, L>; 3]> {
    let lane = |group: &[[f32; 3]], k: usize| {
        Simd::from_array(std::array::from_fn(|j| group[j.min(group.len() - 1)][k]))
    };
    points.chunks(L).map(|g| [lane(g, 0), lane(g, 1), lane(g, 2)]).collect()
}

/// `L` points moved by a pose.
#[inline(always)]
pub fn place_group<const L: usize>(m: &Pose, p: &[Simd<f32, L>; 3]) -> [Simd<f32, L>; 3] {
    let s = |i: usize| Simd::splat(m[i]);
    [
        s(0) * p[0] + s(1) * p[1] + s(2) * p[2] + s(9),
        s(3) * p[0] + s(4) * p[1] + s(5) * p[2] + s(10),
        s(6) * p[0] + s(7) * p[1] + s(8) * p[2] + s(11),
    ]
}

/// One point moved by a pose.
#[inline(always)]
pub fn place(m: &Pose, p: &[f32; 3]) -> [f32; 3] {
    [
        m[0] * p[0] + m[1] * p[1] + m[2] * p[2] + m[9],
        m[3] * p[0] + m[4] * p[1] + m[5] * p[2] + m[10],
        m[6] * p[0] + m[7] * p[1] + m[8] * p[2] + m[11],
    ]
}
