//! A side: one peer with its settings, ready to say of a pose whether the avatar touches.

use crate::case::{Pose, groups, place, place_group};
use crate::heap;
use capt::Capt;
use mvtable::Mvt;
use std::rc::Rc;
use std::simd::Simd;
use std::time::Instant;

type Touches = Box<dyn Fn(&Pose) -> bool>;

/// A structure over the scene, with what it cost.
pub struct Built<T> {
    tree: Rc<T>,
    pub seconds: f64,
    pub heap_bytes: usize,
    pub own_bytes: usize,
}

impl<T> Clone for Built<T> {
    fn clone(&self) -> Self {
        Self { tree: Rc::clone(&self.tree), ..*self }
    }
}

fn build<T>(make: impl FnOnce() -> T, own: impl FnOnce(&T) -> usize) -> Built<T> {
    let (before, start) = (heap::live(), Instant::now());
    let tree = make();
    let seconds = start.elapsed().as_secs_f64();
    let own_bytes = own(&tree);
    Built { tree: Rc::new(tree), seconds, heap_bytes: heap::live() - before, own_bytes }
}

pub type Tree = Capt<3, f32, u32>;

/// CAPT for queries of exactly one radius: the narrowest range it may be given, and so the fewest copies.
/// u32 indices where the crate's default is usize: half the bytes to gather.
pub fn build_capt(scene: &[[f32; 3]], distance: f32, lanes: usize) -> Built<Tree> {
    build(|| Capt::new(scene, (distance, distance), lanes), Capt::memory_used)
}

/// The voxel table with cells `width` wide. Any width is right: a query looks at every cell in its reach.
pub fn build_mvt(scene: &[[f32; 3]], width: f32) -> Built<Mvt<3>> {
    build(|| Mvt::new(scene, width), Mvt::memory_used)
}

/// One peer with its settings. `name` is what the report calls it; `lanes` is 1 for the scalar interface.
pub struct Side {
    pub name: &'static str,
    pub lanes: usize,
    pub order: &'static str,
    pub width: Option<f32>,
    pub build_seconds: f64,
    pub heap_bytes: usize,
    pub own_bytes: usize,
    touches: Touches,
}

// The avatar is placed a group at a time, just before the group is asked about: a pose that touches early
// places no more than it must. The closure is monomorphic inside; the box costs one call a pose.
fn one_by_one(avatar: &[[f32; 3]], hit: impl Fn(&[f32; 3]) -> bool + 'static) -> Touches {
    let avatar = avatar.to_vec();
    Box::new(move |pose| avatar.iter().any(|p| hit(&place(pose, p))))
}

fn by_group<const L: usize>(
    avatar: &[[f32; 3]],
    hit: impl Fn(&[Simd<f32, L>; 3]) -> bool + 'static,
) -> Touches {
    let avatar = groups::<L>(avatar);
    Box::new(move |pose| avatar.iter().any(|g| hit(&place_group(pose, g))))
}

impl Side {
    /// CAPT asked in vectors of `L`, or point by point where `L` is 1.
    pub fn capt<const L: usize>(
        name: &'static str,
        built: &Built<Tree>,
        (order, avatar): (&'static str, &[[f32; 3]]),
        distance: f32,
    ) -> Self {
        let tree = Rc::clone(&built.tree);
        let touches = if L == 1 {
            one_by_one(avatar, move |p| tree.collides(p, distance))
        } else {
            by_group::<L>(avatar, move |g| tree.collides_simd(g, Simd::splat(distance)))
        };
        Self::of(name, L, order, None, built, touches)
    }

    /// The voxel table asked in vectors of `L`, or point by point where `L` is 1.
    pub fn mvt<const L: usize>(
        name: &'static str,
        built: &Built<Mvt<3>>,
        (order, avatar): (&'static str, &[[f32; 3]]),
        distance: f32,
    ) -> Self {
        let (tree, width) = (Rc::clone(&built.tree), built.tree.voxel_width());
        let touches = if L == 1 {
            one_by_one(avatar, move |p| tree.collides(p, distance))
        } else {
            by_group::<L>(avatar, move |g| tree.collides_simd(g, Simd::splat(distance)))
        };
        Self::of(name, L, order, Some(width), built, touches)
    }

    fn of<T>(
        name: &'static str,
        lanes: usize,
        order: &'static str,
        width: Option<f32>,
        built: &Built<T>,
        touches: Touches,
    ) -> Self {
        let (build_seconds, heap_bytes, own_bytes) = (built.seconds, built.heap_bytes, built.own_bytes);
        Self { name, lanes, order, width, build_seconds, heap_bytes, own_bytes, touches }
    }

    /// One loop over the poses: microseconds a pose.
    pub fn time(&self, poses: &[Pose]) -> f64 {
        let start = Instant::now();
        let touching = poses.iter().filter(|p| (self.touches)(p)).count();
        let microseconds = start.elapsed().as_secs_f64() * 1e6;
        std::hint::black_box(touching);
        microseconds / poses.len() as f64
    }

    /// One byte a pose: 1 where the avatar touches.
    pub fn verdicts(&self, poses: &[Pose]) -> Vec<u8> {
        poses.iter().map(|p| u8::from((self.touches)(p))).collect()
    }

    /// Microseconds of each pose alone, the least of `loops`; each holds two readings of the clock (about 0.05).
    pub fn time_each(&self, poses: &[Pose], loops: usize) -> Vec<f32> {
        let mut least = vec![f32::INFINITY; poses.len()];
        for _ in 0..loops {
            for (pose, best) in poses.iter().zip(&mut least) {
                let start = Instant::now();
                std::hint::black_box((self.touches)(pose));
                *best = best.min(start.elapsed().as_secs_f32() * 1e6);
            }
        }
        least
    }
}
