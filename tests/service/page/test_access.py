"""Who may look and who may change: the rules that need no network."""

import pytest

from neurove_service.page.access import Access, same_origin


def access(**kinds):
    tokens = []
    made = Access(on_operator_token=tokens.append, **({"loopback": True, "operator": False} | kinds))
    made.issue()
    return made, tokens


def test_an_operator_token_works_once_and_a_new_one_follows():
    made, tokens = access(operator=True)
    first = tokens[-1]
    key, role = made.redeem(first)
    assert (role, made.role(key)) == ("operator", "operator")
    assert made.redeem(first) is None
    assert len(tokens) == 2
    assert made.redeem(tokens[-1])[1] == "operator"


def test_without_operator_no_token_allows_a_change():
    made, tokens = access()
    assert tokens == []
    assert made.redeem("") is None
    assert made.redeem("x" * 22) is None
    assert made.role(None) == "viewer"


def test_beyond_loopback_looking_needs_the_token_of_viewers():
    made, _ = access(loopback=False)
    assert made.role(None) == made.role("guess") == "none"
    key, role = made.redeem(made.viewer_token)
    assert (role, made.role(key)) == ("viewer", "viewer")
    assert made.redeem(made.viewer_token)[1] == "viewer"  # several viewers share it


def test_the_number_of_keys_is_bounded():
    made, _ = access(loopback=False)
    keys = [made.redeem(made.viewer_token)[0] for _ in range(200)]
    assert made.role(keys[-1]) == "viewer"
    assert made.role(keys[0]) == "none"


@pytest.mark.parametrize("host", ["127.0.0.1:7480", "localhost:1", "[::1]:7480", "localhost"])
def test_on_loopback_the_names_of_this_machine_are_allowed(host):
    assert access()[0].host_allowed(host)


@pytest.mark.parametrize("host", ["evil.example:7480", "127.0.0.1.evil.example", "", "localhost.evil:80"])
def test_on_loopback_a_rebound_name_is_refused(host):
    assert not access()[0].host_allowed(host)


@pytest.mark.parametrize("origin", [None, "null", "", "http://evil.example", "http://localhost:7481", "localhost:7480"])
def test_another_origin_is_refused(origin):
    assert not same_origin(origin, "localhost:7480")


def test_the_own_origin_is_accepted():
    assert same_origin("http://localhost:7480", "localhost:7480")
    assert same_origin("https://rover.lan", "rover.lan")  # behind a proxy with TLS


def test_a_token_that_is_no_text_is_wrong_as_any_other():
    made, _ = access(operator=True)
    assert made.redeem("\ud800") is None
