"""The table of speed figures: values of the rows that it names, judged by their bounds."""

from neurove_core.bench import Row
from neurove_core.bench.figures import FIGURES, table


def row_of(name: str, peer: str, ratio: float, share: float | None = None) -> Row:
    return Row(name, 1.0, peer, ratio, ratio, share, equal=True)


def lines(*rows: Row) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table(rows).splitlines()[2:]]


def test_without_measurements_every_figure_says_so():
    found = lines()
    assert len(found) == len(FIGURES)
    assert {line[2] for line in found} == {"not measured"}


def test_a_ratio_is_judged_by_must_and_goal():
    name = "window shipped, as served"
    for ratio, reached in ((4.99, "no"), (5.0, "must"), (7.9, "must"), (8.0, "goal")):
        found = lines(row_of(name, "PyTorch, plain", 2.0), row_of(name, "spikingjelly", ratio))
        assert found[1][1:] == ["spikingjelly", f"{ratio:.3g}", "5", "8", reached]


def test_the_plain_form_stands_in_for_a_peer_that_is_not_installed():
    assert lines(row_of("window shipped, as served", "PyTorch, plain", 6.0))[1][1:3] == ["PyTorch, plain", "6"]


def test_a_share_of_the_limit_is_judged_whatever_the_ratio_to_the_peer_is():
    found = lines(row_of("ingest 1e+05 events, 346x260, n=10", "numpy", 99.0, share=0.5))
    assert found[6][1:] == ["bare increments", "50%", "55%", "70%", "no"]


def test_less_time_over_the_floor_is_better():
    for ratio, reached in ((1 / 1.5, "no"), (1 / 1.3, "must"), (1 / 1.1, "goal")):
        found = lines(row_of("wire to window, packets of 10000 events", "receive and frombuffer", ratio))
        assert (found[10][2], found[10][-1]) == (f"{1 / ratio:.3g} times the floor", reached)
