//! Forests as a plan that is quick to follow.
//!
//! In: the graph as the inference library has read it. Out: the same graph, whose forests find the votes of a leaf at
//! once. The library walks through the votes of all leaves before it (tract-onnx-opl 0.23, `eval_unchecked`), so a
//! default forest of scikit-learn took 20 to 40 ms. The votes are added in the same order: the numbers are the same.

use tract_onnx::tract_core::internal::*;
use tract_onnx_opl::ml::tree_ensemble_classifier::{TreeEnsembleClassifier, TreeEnsembleData};

/// A forest that votes for classes.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Forest {
    /// The first node of each tree.
    roots: Vec<u32>,
    nodes: Vec<Node>,
    /// The class and the bits of the weight of each vote.
    votes: Vec<[u32; 2]>,
    classes: usize,
    /// The number of features that it needs.
    features: usize,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Node {
    /// A feature is compared with a number, whose bits these are.
    Branch {
        feature: u32,
        number: u32,
        comparison: u8,
        is_true_for_nan: bool,
        yes: u32,
        no: u32,
    },
    /// The votes of a leaf.
    Leaf { from: u32, to: u32 },
}

/// Puts a [`Forest`] in the place of each of the library's own.
pub(super) fn quicken(model: &mut TypedModel) -> TractResult<()> {
    for node in &mut model.nodes {
        if let Some(TreeEnsembleClassifier { ensemble }) = node.op_as() {
            let (classes, features) = (ensemble.n_classes, ensemble.max_used_feature + 1);
            node.op = Box::new(Forest::new(&ensemble.data, classes, features)?);
        }
    }
    Ok(())
}

impl Forest {
    fn new(data: &TreeEnsembleData, classes: usize, features: usize) -> TractResult<Self> {
        let nodes = data.nodes.try_as_plain_ram()?.as_slice::<u32>()?;
        let votes = data.leaves.try_as_plain_ram()?.as_slice::<u32>()?;
        let nodes = nodes.as_chunks::<5>().0.iter();
        let node = |&[a, b, c, number, kind]: &[u32; 5]| match kind as u8 {
            0 => Node::Leaf { from: a, to: b },
            comparison => Node::Branch {
                feature: a,
                number,
                comparison,
                is_true_for_nan: kind & 0x100 != 0,
                yes: b,
                no: c,
            },
        };
        Ok(Self {
            roots: data.trees.try_as_plain_ram()?.as_slice::<u32>()?.to_vec(),
            nodes: nodes.map(node).collect(),
            votes: votes.as_chunks::<2>().0.to_vec(),
            classes,
            features,
        })
    }

    /// The votes of the leaf that a tree comes to.
    fn votes(&self, root: u32, features: &[f32]) -> &[[u32; 2]] {
        let mut at = root;
        loop {
            match self.nodes[at as usize] {
                Node::Leaf { from, to } => return &self.votes[from as usize..to as usize],
                Node::Branch {
                    feature,
                    number,
                    comparison,
                    is_true_for_nan,
                    yes,
                    no,
                } => {
                    let (found, number) = (features[feature as usize], f32::from_bits(number));
                    // The numbers of tract's `Cmp`.
                    let is_true = match comparison {
                        _ if found.is_nan() => is_true_for_nan,
                        1 => found == number,
                        2 => found != number,
                        3 => found < number,
                        4 => found > number,
                        5 => found <= number,
                        _ => found >= number,
                    };
                    at = if is_true { yes } else { no };
                }
            }
        }
    }
}

impl Op for Forest {
    fn name(&self) -> StaticName {
        "Forest".into()
    }

    op_as_typed_op!();
}

impl EvalOp for Forest {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let input = args_1!(inputs);
        let input = input.cast_to::<f32>()?;
        let features = input.try_as_plain_ram()?.as_slice::<f32>()?;
        if input.shape() != [1, features.len()] || features.len() < self.features {
            bail!(
                "found features {:?}, expected [1, {}]",
                input.shape(),
                self.features
            );
        }
        let mut sums = vec![0.0_f32; self.classes];
        for &root in &self.roots {
            for &[class, weight] in self.votes(root, features) {
                sums[class as usize] += f32::from_bits(weight);
            }
        }
        let sums = tensor1(&sums).into_shape(&[1, self.classes])?;
        Ok(tvec!(sums.into_tvalue()))
    }
}

impl TypedOp for Forest {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(f32::fact([1, self.classes])))
    }

    as_op!();
}
