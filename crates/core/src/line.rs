//! What many numbers have in common: the sums from which the slope of a line through points follows (least
//! squares), and the extent.

/// The sums of squares and products of points, about their means.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Sums {
    /// The number of points.
    pub count: f64,
    /// Of the squares of x.
    pub xx: f64,
    /// Of the products of x and y.
    pub xy: f64,
    /// Of the squares of y.
    pub yy: f64,
}

impl Sums {
    /// The sums of these points.
    pub fn of(points: &[(f64, f64)]) -> Self {
        let count = points.len() as f64;
        let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / count;
        let (mean_x, mean_y) = (mean(|point| point.0), mean(|point| point.1));
        let mut sums = Self {
            count,
            ..Self::default()
        };
        for (x, y) in points {
            let (x, y) = (x - mean_x, y - mean_y);
            sums.xx += x * x;
            sums.xy += x * y;
            sums.yy += y * y;
        }
        sums
    }
}

/// The least and the greatest of some numbers that are not below 0. Of none, they are infinity and 0.
pub fn extent(numbers: impl Iterator<Item = f64>) -> [f64; 2] {
    let with = |[least, most]: [f64; 2], number: f64| [number.min(least), number.max(most)];
    numbers.fold([f64::INFINITY, 0.0], with)
}
