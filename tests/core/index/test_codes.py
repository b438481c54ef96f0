"""Codes: estimates are unbiased and close, each row's code is its own, and a coder survives being stored."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.index import Coder, Codes
from core.index.codes import PlaneQuery
from core.index.rotation import random_signs
from core.kernels.codes import estimates_at, estimates_of
from tests.core.index.made_up import Array, descriptors, second_looks

WIDE = 4096


def estimated(codes: Codes, query: PlaneQuery) -> Array:
    made = np.empty(len(codes), np.float32)
    estimates_of(codes.bits, codes.scales[:, 1], query.planes, query.step, query.total, made)
    return made


def test_estimates_have_no_bias_and_the_error_of_the_paper() -> None:
    """RaBitQ, theorem 3.2: over rotations the mean is the inner product, the deviation about √((π/2 - 1) / D)."""
    rows = descriptors(40, WIDE)
    query = second_looks(rows)[7]
    truth, fitted = rows @ query, Coder.fitted(rows)
    errors = []
    for seed in range(60):
        coder = replace(fitted, signs=random_signs(WIDE, seed))
        errors.append(estimated(coder.encode(rows), coder.query(query).code) - truth)
    relative = np.array(errors) / (np.linalg.norm(rows, axis=1) * np.linalg.norm(query))
    expected = np.sqrt((np.pi / 2 - 1) / WIDE)
    assert abs(relative.mean()) < 3 * expected / np.sqrt(relative.size)
    assert np.abs(relative.mean(axis=0)).max() < 4.5 * expected / np.sqrt(len(errors))
    assert relative.std() == pytest.approx(expected, rel=0.15)


def test_sketches_rank_alike_with_the_inner_products() -> None:
    rows = descriptors(3000)
    coder = Coder.fitted(rows[:500])
    codes, query = coder.encode(rows), coder.query(second_looks(rows[:1])[0])
    made = np.empty(len(rows), np.float32)
    estimates_of(codes.sketches, codes.scales[:, 0], query.sketch.planes, query.sketch.step, query.sketch.total, made)
    truth = rows @ second_looks(rows[:1])[0]
    assert np.corrcoef(made, truth)[0, 1] > 0.8
    assert made.argmax() == truth.argmax() == 0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 6))
def test_the_kernel_counts_as_plain_arithmetic_does(seed: int, groups: int) -> None:
    random = np.random.default_rng(seed)
    codes = random.integers(0, 2**64, (5, 8 * groups), dtype=np.uint64)
    planes = random.integers(0, 2**64, (groups, 4, 8), dtype=np.uint64)
    scales = random.random(5, dtype=np.float32)
    expected = []
    for row, scale in zip(codes.reshape(5, groups, 8).tolist(), scales.tolist(), strict=True):
        sums = sum(
            (int(word & planes[group, plane, k].item()).bit_count() << plane) * (-1 if plane == 3 else 1)
            for group, words in enumerate(row)
            for k, word in enumerate(words)
            for plane in range(4)
        )
        expected.append(scale * (0.5 * sums - 3))
    made, picked = np.empty(5, np.float32), np.empty(2, np.float32)
    estimates_of(codes, scales, planes, np.float32(0.5), np.float32(3), made)
    assert np.allclose(made, expected, rtol=1e-5, atol=1e-4)
    estimates_at(codes, scales, planes, np.float32(0.5), np.float32(3), np.array([4, 1]), picked)
    assert np.array_equal(picked, made[[4, 1]])


def test_a_code_depends_on_its_own_row_alone() -> None:
    rows = descriptors(700)
    coder = Coder.fitted(rows)
    together, alone = coder.encode(rows), coder.encode(rows[600:601])
    assert np.array_equal(together.bits[600:601], alone.bits)
    assert np.allclose(together.scales[600:601], alone.scales, rtol=1e-5)
    apart = np.bitwise_count(together.sketches[600:601] ^ alone.sketches).sum()
    assert apart <= 2  # a product of matrices may round otherwise for another number of rows


def test_a_coder_comes_back_from_its_tensors() -> None:
    rows = descriptors(50)
    coder = Coder.fitted(rows)
    again = Coder.of({name: tensor.copy() for name, tensor in coder.tensors().items()})
    for made, kept in zip(again.tensors().values(), coder.tensors().values(), strict=True):
        assert np.array_equal(made, kept)
    assert np.array_equal(again.encode(rows).bits, coder.encode(rows).bits)


@pytest.mark.parametrize("damage", ["missing", "dimension", "shape"])
def test_other_tensors_are_refused(damage: str) -> None:
    tensors = Coder.fitted(descriptors(20)).tensors()
    if damage == "missing":
        del tensors["within"]
    elif damage == "dimension":
        tensors["dimension"] = np.array([4096])
    else:
        tensors["across"] = tensors["across"][:-1]
    with pytest.raises(ValueError, match="not the tensors of a coder"):
        Coder.of(tensors)


@pytest.mark.parametrize("dimension", [1, 100, 512, 1472])
def test_any_dimension_can_be_coded(dimension: int) -> None:
    rows = np.random.default_rng(0).standard_normal((30, dimension)).astype(np.float32)
    coder = Coder.fitted(rows)
    codes = coder.encode(rows)
    assert (codes.sketches.shape[1], codes.bits.shape[1], codes.scales.shape[1]) == coder.shape
    assert codes.bits.shape[1] * 64 >= dimension
    assert coder.bytes_per_place == (codes.sketches.nbytes + codes.bits.nbytes + codes.scales.nbytes) // 30


def test_the_default_encoders_code_takes_two_kilobytes() -> None:
    coder = Coder.fitted(np.random.default_rng(0).standard_normal((3, 16_384)).astype(np.float32))
    assert coder.shape == (8, 256, 2)
    assert coder.bytes_per_place == 2120


def test_a_blank_descriptor_is_estimated_as_zero() -> None:
    rows = descriptors(10)
    rows[3] = 0
    coder = Coder.fitted(rows)
    assert estimated(coder.encode(rows), coder.query(rows[0]).code)[3] == 0
    assert (estimated(coder.encode(rows), coder.query(rows[3]).code) == 0).all()


def test_what_is_not_a_descriptor_is_refused() -> None:
    coder = Coder.fitted(descriptors(5))
    with pytest.raises(ValueError, match="descriptors of 1024 values"):
        coder.encode(np.zeros((2, 512), np.float32))
    with pytest.raises(ValueError, match="descriptors of 1024 values"):
        coder.query(np.zeros(512, np.float32))
    with pytest.raises(ValueError, match="at least one descriptor"):
        Coder.fitted(np.zeros((0, 1024), np.float32))


def test_full_codes_are_the_same_on_every_machine() -> None:
    """They are made of sums in a fixed order; sketches go through BLAS, and are not."""
    ramp = ((np.arange(3 * 1024) * 7919 % 1009) / 1009 - 0.5).astype(np.float32).reshape(3, 1024)
    bits = Coder.fitted(ramp).encode(ramp).bits
    assert hashlib.sha256(bits.astype("<u8").tobytes()).hexdigest()[:16] == "2175f65124c10377"
