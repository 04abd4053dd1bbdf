"""Steps of a rollout."""

import pytest

from neurove_protocol.errors import InvalidField
from neurove_service.fleet import plan


@pytest.mark.parametrize("nodes", [0, 1, 2, 5, 10, 11, 999])
@pytest.mark.parametrize("text", ["1,10%,100%", "50%", "3,7,1%,2%,100%"])
def test_each_step_adds_nodes_and_none_is_counted_twice(text, nodes):
    sizes = plan.sizes(plan.parse(text), nodes)
    assert sizes == sorted(set(sizes))
    assert all(0 < size <= nodes for size in sizes)
    assert text == "50%" or sizes[-1:] == [nodes] * bool(nodes)


@pytest.mark.parametrize(
    "text", ["", "0", "0%", "101%", "1,1", "10%,5%", "5,3", "-1", "1.5", "a", ",".join(["1"] * 51)]
)
def test_a_wrong_plan_is_refused(text):
    with pytest.raises(InvalidField, match="--plan="):
        plan.parse(text)
