"""The operators of the ONNX format: each is known, or refused."""

from __future__ import annotations

import onnx
import pytest
from onnx import TensorProto, helper

from core.errors import InvalidModel
from core.networks.operators import PLAIN, SHAPED, check_operator, check_shapes

REFUSED = {
    *("If", "Loop", "Scan", "SequenceMap"),  # branches and loops
    *("Bernoulli", "Multinomial", "RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike"),
    *("ConcatFromSequence", "SequenceAt", "SequenceConstruct", "SequenceEmpty", "SequenceErase", "SequenceInsert"),
    *("SequenceLength", "SplitToSequence", "Optional", "OptionalGetElement", "OptionalHasElement"),  # lists
    *("ImageDecoder", "RegexFullMatch", "StringConcat", "StringNormalizer", "StringSplit", "TfIdfVectorizer"),  # texts
}


def test_each_operator_is_known_or_refused() -> None:
    """One that is new in the format is neither, and refused until somebody has looked at it."""
    schemas = [one for one in onnx.defs.get_all_schemas_with_history() if one.domain in ("", "ai.onnx")]
    assert {one.name for one in schemas} <= PLAIN | SHAPED.keys() | REFUSED
    assert not PLAIN & SHAPED.keys() and not (PLAIN | SHAPED.keys()) & REFUSED
    inputs = {name: max(len(one.inputs) for one in schemas if one.name == name) for name in SHAPED}
    assert all(max(positions) < inputs[name] for name, positions in SHAPED.items())


@pytest.mark.parametrize("name", sorted({*REFUSED, "OfALaterVersion"}))
def test_an_operator_that_is_not_known_is_refused(name: str) -> None:
    with pytest.raises(InvalidModel, match=name):
        check_operator(helper.make_node(name, ["x"], ["y"]))


def test_a_value_has_one_origin() -> None:
    """Else a node that gives a constant could hide one that gives what it sees."""
    taken = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    for second in ("y", "x"):
        nodes = [helper.make_node("Relu", ["x"], ["y"]), helper.make_node("Constant", [], [second], value_int=1)]
        with pytest.raises(InvalidModel, match="twice"):
            check_shapes(helper.make_graph(nodes, "graph", [taken], []))
