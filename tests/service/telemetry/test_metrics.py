"""The exposition stays small whatever callers do."""

from __future__ import annotations

from prometheus_client.parser import text_string_to_metric_families

from service.telemetry.metrics import MOST_MAPS, MOST_REQUEST_SERIES, OTHERS, MapCollector, Metrics


def samples(metrics: Metrics, name: str) -> dict[tuple[str, ...], float]:
    """The values of a series by the values of its labels."""
    families = text_string_to_metric_families(metrics.expose().decode())
    return {tuple(one.labels.values()): one.value for family in families for one in family.samples if one.name == name}


def test_requests_of_many_kinds_share_a_series() -> None:
    metrics = Metrics()
    for number in range(10 * MOST_REQUEST_SERIES):
        metrics.observe_request(f"/v1/{number}", "GET", 200 + number % 3, 0.01)
    counts = samples(metrics, "placerec_request_seconds_count")
    assert len(counts) == MOST_REQUEST_SERIES + 3 and sum(counts.values()) == 10 * MOST_REQUEST_SERIES
    assert sum(count for labels, count in counts.items() if OTHERS in labels) == 9 * MOST_REQUEST_SERIES
    assert len(metrics.expose()) < 512 * 1024


def test_maps_beyond_the_first_share_a_series_and_a_deleted_one_makes_room() -> None:
    metrics = Metrics()
    collector = MapCollector(lambda: {f"m{number:04}": number for number in range(3 * MOST_MAPS)}, lambda: 0)
    metrics.registry.register(collector)
    for number in range(3 * MOST_MAPS):
        metrics.observe_answer(f"m{number:04}", "unknown", 0.1)
    verdicts, places = samples(metrics, "placerec_verdicts_total"), samples(metrics, "placerec_map_places")
    assert len(verdicts) == MOST_MAPS + 1 and sum(verdicts.values()) == 3 * MOST_MAPS
    assert len(places) == MOST_MAPS + 1 and sum(places.values()) == sum(range(3 * MOST_MAPS))
    assert places[(f"m{3 * MOST_MAPS - 1:04}",)] == 3 * MOST_MAPS - 1, "the largest are shown apart"
    metrics.forget_map("m0000")
    metrics.observe_answer("new", "recognized", 0.5)
    assert ("new", "recognized") in samples(metrics, "placerec_verdicts_total")
    assert len(samples(metrics, "placerec_best_score_count")) == MOST_MAPS + 1
