//! Forests as a plan that is quick to follow.
//!
//! In: the graph as the inference library has read it. Out: the same graph, whose forests find the votes of a leaf at
//! once. The library walks through the votes of all leaves before it (tract-onnx-opl 0.23, `eval_unchecked`), so a
//! default forest of scikit-learn took 20 to 40 ms. The votes are added in the same order: the numbers are the same.

use tract_onnx::tract_core::internal::*;
use tract_onnx_opl::ml::tree_ensemble_classifier::{TreeEnsemble, TreeEnsembleClassifier};

/// A forest that votes for classes.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Forest(TreeEnsemble);

/// Puts a [`Forest`] in the place of each of the library's own.
pub(super) fn quicken(model: &mut TypedModel) {
    for node in &mut model.nodes {
        if let Some(TreeEnsembleClassifier { ensemble }) = node.op_as() {
            node.op = Box::new(Forest(ensemble.clone()));
        }
    }
}

fn numbers(tensor: &Tensor) -> TractResult<&[u32]> {
    tensor.try_as_plain_ram()?.as_slice()
}

/// The votes of the leaf that a tree comes to: the first one, and the one after the last.
fn votes(nodes: &[[u32; 5]], root: u32, features: &[f32]) -> [usize; 2] {
    let mut at = root;
    loop {
        // In a leaf, the first two numbers are its votes. In a branch, a feature is compared with a number, whose bits
        // are there, and the next node is another one for each outcome.
        let [feature, yes, no, number, kind] = nodes[at as usize];
        if kind as u8 == 0 {
            return [feature, yes].map(|vote| vote as usize);
        }
        let (found, number) = (features[feature as usize], f32::from_bits(number));
        // The numbers of tract's `Cmp`.
        let is_true = match kind as u8 {
            _ if found.is_nan() => kind & 0x100 != 0,
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

impl Op for Forest {
    fn name(&self) -> StaticName {
        "Forest".into()
    }

    op_as_typed_op!();
}

impl EvalOp for Forest {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        let Self(forest) = self;
        let input = args_1!(inputs);
        let input = input.cast_to::<f32>()?;
        let features = input.try_as_plain_ram()?.as_slice::<f32>()?;
        if input.shape() != [1, features.len()] || features.len() <= forest.max_used_feature {
            let (found, most) = (input.shape(), forest.max_used_feature + 1);
            bail!("found features {found:?}, expected [1, {most}]");
        }
        let (nodes, _) = numbers(&forest.data.nodes)?.as_chunks();
        let (all, _) = numbers(&forest.data.leaves)?.as_chunks();
        let mut sums = vec![0.0_f32; forest.n_classes];
        for &root in numbers(&forest.data.trees)? {
            let [from, to] = votes(nodes, root, features);
            for &[class, weight] in &all[from..to] {
                sums[class as usize] += f32::from_bits(weight);
            }
        }
        let sums = tensor1(&sums).into_shape(&[1, forest.n_classes])?;
        Ok(tvec!(sums.into_tvalue()))
    }
}

impl TypedOp for Forest {
    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec!(f32::fact([1, self.0.n_classes])))
    }

    as_op!();
}
