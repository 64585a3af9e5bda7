//! The results that the paper reports, for the tables and tests that compare with them.

/// A method's row in the paper's Tables 2 and 3.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Our name of the method.
    pub method: &'static str,
    /// Table 2: category accuracies of levels 1 to 4, per cent.
    pub category_accuracy_percent: [f64; 4],
    /// Table 2: overall accuracy, per cent.
    pub accuracy_percent: f64,
    /// Table 3 as counts of 250 a level: rows are the truth, columns the prediction. The paper
    /// prints shares, each a whole number of 250ths.
    pub confusion: [[u64; 4]; 4],
    /// Table 3: kappa, Eq. (14).
    pub kappa: f64,
}

/// Both tables, in the order of the paper's Table 2.
pub const TABLES: [Row; 8] = [
    Row {
        method: "hrn15",
        category_accuracy_percent: [67.2, 61.2, 56.8, 71.6],
        accuracy_percent: 64.2,
        confusion: [
            [168, 51, 19, 12],
            [30, 153, 53, 14],
            [19, 56, 142, 33],
            [11, 25, 35, 179],
        ],
        kappa: 0.5227,
    },
    Row {
        method: "hrn50",
        category_accuracy_percent: [89.6, 84.4, 80.8, 91.6],
        accuracy_percent: 86.6,
        confusion: [
            [224, 15, 7, 4],
            [13, 211, 17, 9],
            [11, 24, 202, 13],
            [2, 5, 14, 229],
        ],
        kappa: 0.8213,
    },
    Row {
        method: "hrn100",
        category_accuracy_percent: [97.6, 94.4, 92.4, 99.2],
        accuracy_percent: 95.9,
        confusion: [
            [244, 5, 1, 0],
            [5, 236, 7, 2],
            [6, 10, 231, 3],
            [0, 0, 2, 248],
        ],
        kappa: 0.9453,
    },
    Row {
        method: "sgan",
        category_accuracy_percent: [89.2, 84.0, 80.4, 91.2],
        accuracy_percent: 86.2,
        confusion: [
            [223, 19, 5, 3],
            [12, 210, 18, 10],
            [11, 26, 201, 12],
            [2, 7, 13, 228],
        ],
        kappa: 0.816,
    },
    Row {
        method: "igan",
        category_accuracy_percent: [91.6, 85.2, 81.6, 92.8],
        accuracy_percent: 87.8,
        confusion: [
            [229, 14, 5, 2],
            [12, 213, 16, 9],
            [10, 24, 204, 12],
            [2, 5, 11, 232],
        ],
        kappa: 0.8373,
    },
    Row {
        method: "nahrn",
        category_accuracy_percent: [89.2, 83.2, 78.8, 91.6],
        accuracy_percent: 85.7,
        confusion: [
            [223, 17, 7, 3],
            [13, 208, 19, 10],
            [12, 27, 197, 14],
            [3, 5, 13, 229],
        ],
        kappa: 0.8093,
    },
    Row {
        method: "nihrn",
        category_accuracy_percent: [92.4, 88.4, 84.8, 94.8],
        accuracy_percent: 90.1,
        confusion: [
            [231, 11, 6, 2],
            [9, 221, 15, 5],
            [9, 21, 212, 8],
            [1, 5, 7, 237],
        ],
        kappa: 0.868,
    },
    Row {
        method: "ours",
        category_accuracy_percent: [96.4, 92.8, 90.0, 98.4],
        accuracy_percent: 94.4,
        confusion: [
            [241, 6, 3, 0],
            [5, 232, 10, 3],
            [6, 18, 225, 1],
            [0, 0, 4, 246],
        ],
        kappa: 0.9253,
    },
];

/// The paper's row of a method, if it has one.
pub fn row(method: &str) -> Option<&'static Row> {
    TABLES.iter().find(|row| row.method == method)
}

impl Row {
    /// The confusion matrix in the form that our metrics take.
    pub fn counts(&self) -> Vec<Vec<u64>> {
        self.confusion.iter().map(|row| row.to_vec()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_2_follows_from_the_counts_of_table_3() {
        for row in &TABLES {
            let right: Vec<u64> = (0..4).map(|level| row.confusion[level][level]).collect();
            for (level, counts) in row.confusion.iter().enumerate() {
                assert_eq!(counts.iter().sum::<u64>(), 250, "{}", row.method);
                let percent = right[level] as f64 / 2.5;
                let printed = row.category_accuracy_percent[level];
                assert!(
                    (percent - printed).abs() < 1e-9,
                    "{}: {percent}",
                    row.method
                );
            }
        }
    }
}
