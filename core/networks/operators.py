"""The operators of the ONNX format that a network may have, and which of their inputs decide the size of the result.

A network needs as much memory for every frame as its trial at the import has needed only if no size depends on the
pixels: then all sizes follow from that of the input, and are those of the trial.  So there are no branches and loops,
and no operator may get from the picture what decides the shape of its result.

An operator that is not listed here is refused, also if a later version of the format has it.
"""

from __future__ import annotations

from onnx import GraphProto, NodeProto

from core.errors import InvalidModel

_PLAIN = """
Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh Attention AveragePool BatchNormalization BitCast BitShift
BitwiseAnd BitwiseNot BitwiseOr BitwiseXor Cast CastLike CausalConvWithState Ceil Celu Clip Concat Constant Conv
ConvInteger ConvTranspose Cos Cosh CumProd CumSum DeformConv DepthToSpace DequantizeLinear Det Div Dropout
DynamicQuantizeLinear Einsum Elu Equal Erf Exp EyeLike Flatten Floor GRU Gather GatherElements GatherND Gelu Gemm
GlobalAveragePool GlobalLpPool GlobalMaxPool Greater GreaterOrEqual GridSample GroupNormalization HardSigmoid
HardSwish Hardmax Identity InstanceNormalization IsInf IsNaN LRN LSTM LayerNormalization LeakyRelu Less LessOrEqual
LinearAttention Log LogSoftmax LpNormalization LpPool MatMul MatMulInteger Max MaxPool MaxRoiPool Mean
MeanVarianceNormalization Min Mish Mod Mul Neg NegativeLogLikelihoodLoss Not Or PRelu Pow QLinearConv QLinearMatMul
QuantizeLinear RMSNormalization RNN Reciprocal Relu ReverseSequence RoiAlign RotaryEmbedding Round Scatter
ScatterElements ScatterND Selu Shape Shrink Sigmoid Sign Sin Sinh Size Softmax SoftmaxCrossEntropyLoss Softplus
Softsign SpaceToDepth Sqrt Sub Sum SwiGLU Swish Tan Tanh TensorScatter ThresholdedRelu Transpose Trilu Where Xor
"""

PLAIN = frozenset(_PLAIN.split())
"""Operators whose results have a shape that follows from the shapes of their inputs."""

_SHAPED = {
    **dict.fromkeys(("BlackmanWindow", "ConstantOfShape", "HammingWindow", "HannWindow"), (0,)),
    **dict.fromkeys(("AffineGrid", "CenterCropPad", "Expand", "OneHot", "Reshape"), (1,)),
    **dict.fromkeys(("Split", "Squeeze", "TopK", "Unsqueeze", "Upsample"), (1,)),
    **dict.fromkeys(("ReduceL1", "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMax"), (1,)),
    **dict.fromkeys(("ReduceMean", "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare"), (1,)),
    **dict.fromkeys(("Col2Im", "DFT", "Tile"), (1, 2)),
    "MaxUnpool": (2,),
    "MelWeightMatrix": (0, 1),
    "Pad": (1, 3),
    "Range": (0, 1, 2),
    "Resize": (1, 2, 3),
    "STFT": (1, 3),
    "Slice": (1, 2, 3, 4),
    # What these give has as many values as some of their inputs say or meet.
    "Compress": (0, 1),
    "NonMaxSuppression": (0, 1, 2, 3, 4),
    "NonZero": (0,),
    "Unique": (0,),
}

SHAPED = {name: frozenset(positions) for name, positions in _SHAPED.items()}
"""The positions of the inputs whose values decide the shape of an operator's result, by its name."""

CHANCE = frozenset(
    {"Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike"}
)
"""Operators that give other values each time."""

_SHAPES_ALONE = frozenset({"Shape", "Size"})
"""Operators that look at the shape of their input, and at no value."""


def check_operator(node: NodeProto) -> None:
    """Check that a node's operator may be in a network, and has no graph within it.

    Raises:
        InvalidModel: it may not, or has one.
    """
    name = node.op_type[:60]
    if any(attribute.HasField("g") or len(attribute.graphs) for attribute in node.attribute):
        raise InvalidModel(f"It has a {name} with a graph in it, whose work cannot be foreseen; export it unrolled.")
    training = any(attribute.name == "training_mode" and attribute.i for attribute in node.attribute)
    if node.op_type in CHANCE or training:
        raise InvalidModel(f"It has a {name} that gives other values each time; export it for evaluation.")
    if node.op_type not in PLAIN and node.op_type not in SHAPED:
        raise InvalidModel(f"It has a {name}, which no network here may have.")


def check_shapes(graph: GraphProto) -> None:
    """Check that no shape in a graph depends on the values of its input; its operators have been checked.

    Raises:
        InvalidModel: one does, or a value has two origins.
    """
    known = {tensor.name for tensor in graph.initializer}
    made = {value.name for value in graph.input} | known
    for node in graph.node:
        deciding = SHAPED.get(node.op_type, frozenset())
        seen = [position for position, name in enumerate(node.input) if name and name not in known]
        if not deciding.isdisjoint(seen):
            raise InvalidModel(
                f"It has a {node.op_type}, the size of whose result depends on the picture; export it for one size of "
                "input, and without what selects by values."
            )
        outputs = [name for name in node.output if name]
        if twice := made.intersection(outputs) or len(set(outputs)) < len(outputs):
            raise InvalidModel(f"It makes a value twice in a {node.op_type}: {twice!r}."[:200])
        made.update(outputs)
        if not seen or node.op_type in _SHAPES_ALONE:
            known.update(outputs)
