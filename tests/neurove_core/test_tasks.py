"""Tasks in processes of this machine: a lost process costs its task, a failed task costs itself and is named."""

from pathlib import Path

import pytest

from neurove_core import tasks
from neurove_core.tasks import FailedTasks
from neurove_protocol.errors import InvalidField
from tests.neurove_core import works


@pytest.fixture(autouse=True)
def _tests_can_be_imported(monkeypatch):
    """The processes import works.py; they get the path of this process."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


def numbers(count):
    return {f"number {number}": number for number in range(count)}


@pytest.mark.parametrize("workers", [1, 2])
def test_each_task_gives_its_result_by_its_name(workers):
    found = dict(tasks.local(workers).run(works.square, numbers(5)))
    assert found == {f"number {number}": number * number for number in range(5)}


def test_a_failed_task_is_named_after_the_results_of_the_others():
    found = {}
    with pytest.raises(FailedTasks) as failed:
        works.until_failure(tasks.Processes(2).run(works.square_below_3, numbers(5)), found)
    assert found == {"number 0": 0, "number 1": 1, "number 2": 4}
    assert failed.value.message.startswith("2 of 5 tasks failed: number ")
    assert "number 3: ValueError: 3 is too large" in failed.value.message


def test_in_this_process_the_first_exception_is_raised_as_it_is():
    with pytest.raises(ValueError, match="3 is too large"):
        dict(tasks.local(1).run(works.square_below_3, numbers(5)))


def test_the_task_of_a_lost_process_runs_again(tmp_path):
    jobs = {name: (tmp_path, number) for name, number in numbers(5).items()}
    found = dict(tasks.Processes(2).run(works.end_once, jobs))
    assert found == {f"number {number}": number * number for number in range(5)}


def test_a_task_that_always_ends_its_process_costs_only_itself():
    found = {}
    with pytest.raises(FailedTasks, match=r"1 of 5 tasks failed: number 2: it ended its process 2 times"):
        works.until_failure(tasks.Processes(2).run(works.end_always, numbers(5)), found)
    assert sorted(found) == ["number 0", "number 1", "number 3", "number 4"]


def test_the_number_of_processes_is_checked():
    with pytest.raises(InvalidField, match="workers=0: must be at least 1"):
        tasks.local(0)
