"""The scripts that make certificates and configurations: what they make, and what they refuse."""

import json
import re
import stat
import subprocess

import pytest
import zenoh

from neurove_protocol.keys import Keys
from tests.deploy.secured import TLS, access_list, deployment, make_ca, make_configs

NAMES = ("router-box=127.0.0.1,localhost", "node-edge1", "node-edge2=::1", "driver-cam0", "operator-alice")


@pytest.fixture(scope="module")
def pki(tmp_path_factory):
    return deployment(tmp_path_factory.mktemp("pki"), "tls/127.0.0.1:7447", *NAMES)


def text_of(certificate):
    command = ["openssl", "x509", "-in", str(certificate), "-noout", "-text"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


class TestMakeCA:
    def test_it_lists_its_files_and_only_the_owner_can_read_them(self, tmp_path):
        made = make_ca(tmp_path / "pki", *NAMES)
        assert made.returncode == 0, made.stderr
        names = ["ca", *[name.split("=")[0] for name in NAMES]]
        assert [line.split(":")[0] for line in made.stdout.splitlines()] == [
            f"made {tmp_path}/pki/{name}.crt" for name in names
        ]
        files = list((tmp_path / "pki").iterdir())
        assert {file.name for file in files} == {f"{name}.{end}" for name in names for end in ("key", "crt")}
        assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
        assert stat.S_IMODE((tmp_path / "pki").stat().st_mode) == 0o700

    def test_it_keeps_existing_files_and_adds_new_ones(self, tmp_path):
        make_ca(tmp_path, *NAMES)
        before = {file: file.read_bytes() for file in tmp_path.iterdir()}
        again = make_ca(tmp_path, *NAMES, "operator-bob")
        assert again.returncode == 0, again.stderr
        assert f"made {tmp_path}/operator-bob.crt" in again.stdout
        assert again.stdout.count("kept ") == len(NAMES)
        assert {file: file.read_bytes() for file in before} == before

    def test_clients_connect_only_to_certificates_with_hosts(self, pki):
        assert "IP Address:127.0.0.1, DNS:localhost" in text_of(pki / "router-box.crt")
        assert "IP Address:0:0:0:0:0:0:0:1" in text_of(pki / "node-edge2.crt")
        for name, server in (("router-box", True), ("node-edge2", True), ("node-edge1", False), ("driver-cam0", False)):
            assert ("TLS Web Server Authentication" in text_of(pki / f"{name}.crt")) is server
            assert f"CN = {name}\n" in text_of(pki / f"{name}.crt").replace("CN=", "CN = ")

    def test_a_certificate_cannot_sign_another(self, pki):
        assert "CA:FALSE" in text_of(pki / "operator-alice.crt")
        assert "CA:TRUE" in text_of(pki / "ca.crt")

    @pytest.mark.parametrize(
        ("name", "why"),
        [
            ("alice", "give ROLE-NAME"),
            ("root-alice", "give ROLE-NAME"),
            ("operator-", "give ROLE-NAME"),
            ("operator-../x", "give ROLE-NAME"),
            ("operator-a b", "give ROLE-NAME"),
            ("driver-" + "x" * 53, "up to 52 characters"),
            ("router-box", "needs the hosts"),
            ("router-box=", "give hosts"),
            ("router-box=a,,b", "give hosts"),
            ("router-box=a b", "give hosts"),
            ("driver-cam0=127.0.0.1", "only a router or a node listens"),
        ],
    )
    def test_an_invalid_name_is_refused_before_any_file_is_written(self, tmp_path, name, why):
        refused = make_ca(tmp_path / "pki", "operator-alice", name)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert refused.stderr.startswith(f"make-ca.sh: '{name}': ")
        assert why in refused.stderr
        assert not (tmp_path / "pki").exists()

    def test_without_the_authoritys_key_nothing_is_signed(self, tmp_path):
        make_ca(tmp_path, "operator-alice")
        (tmp_path / "ca.key").unlink()
        refused = make_ca(tmp_path, "operator-bob")
        assert refused.returncode == 2
        assert "ca.key is not here" in refused.stderr
        assert not (tmp_path / "operator-bob.crt").exists()

    def test_without_arguments_it_explains_itself(self):
        result = make_ca(None)
        assert result.returncode == 2
        assert "sh make-ca.sh DIR ROLE-NAME[=HOST,...]" in result.stdout


class TestMakeConfigs:
    def test_every_certificate_gets_a_configuration_that_only_its_owner_can_read(self, pki):
        for name in (name.split("=")[0] for name in NAMES):
            file = pki / f"{name}.json5"
            zenoh.Config.from_file(str(file))
            assert stat.S_IMODE(file.stat().st_mode) == 0o600
            assert f"// {name}: " in file.read_text()

    def test_a_listener_uses_only_tls_and_denies_by_default(self, pki):
        for name, mode in (("router-box", "router"), ("node-edge2", "peer")):
            config = zenoh.Config.from_file(str(pki / f"{name}.json5"))
            assert json.loads(config.get_json("mode")) == mode
            assert json.loads(config.get_json("listen/endpoints")) == ["tls/127.0.0.1:7447"]
            assert json.loads(config.get_json("transport/link/protocols")) == ["tls"]
            assert json.loads(config.get_json("transport/link/tls/enable_mtls")) is True
            access = json.loads(config.get_json("access_control"))
            assert (access["enabled"], access["default_permission"]) == (True, "deny")
            assert {rule["permission"] for rule in access["rules"]} == {"allow"}

    def test_the_settings_of_the_plain_router_are_set_here_too(self, pki):
        plain = zenoh.Config.from_file(str(TLS.parent / "zenoh-router.json5"))
        secured = zenoh.Config.from_file(str(pki / "router-box.json5"))
        for key in (
            "transport/shared_memory/enabled",
            "transport/link/rx",
            "transport/link/tx",
            "adminspace",
            "scouting/multicast",
        ):
            assert secured.get_json(key) == plain.get_json(key)

    def test_only_an_operator_may_query_below_model(self, pki):
        rules = access_list(pki / "router-box.json5")["rules"]
        who = {
            rule["id"].split()[0]
            for rule in rules
            if "query" in rule["messages"] and "ingress" in rule["flows"] and includes(rule, Keys().activate("edge1"))
        }
        assert who == {"operator-alice"}

    def test_no_rule_allows_a_wildcard_that_matches_no_message_of_the_protocol(self, pki):
        for rule in access_list(pki / "router-box.json5")["rules"]:
            for key in rule["key_exprs"]:
                assert key.startswith(Keys().prefix + "/")
                assert key.count("**") == 0 or "/model/**" in key or key.endswith("/@push/**")
                assert "delete" not in rule["messages"]

    def test_the_keys_are_those_of_the_protocol_under_any_prefix(self, pki, tmp_path):
        deployment(tmp_path, "tls/127.0.0.1:7447", *NAMES)
        made = make_configs(tmp_path, "--prefix", "site1/robots")
        assert made.returncode == 0, made.stderr
        keys = Keys("site1/robots")
        listed = {key for rule in access_list(tmp_path / "router-box.json5")["rules"] for key in rule["key_exprs"]}
        assert {
            keys.events(),
            keys.camera(),
            keys.velocity(),
            keys.status(),
            keys.health(),
            keys.models(),
            keys.alive("edge1"),
            keys.serves("edge1"),
            keys.events("cam0"),
            keys.camera("cam0"),
        } <= listed

    @pytest.mark.parametrize(
        ("flags", "why"),
        [
            (("--prefix", "a/**"), "--prefix 'a/**'"),
            (("--prefix", 'a"b'), "joined by /"),
            (("--listen", "tcp/0.0.0.0:7447"), "give one address and port, such as tls/"),
        ],
    )
    def test_a_wrong_flag_is_refused(self, pki, flags, why):
        refused = make_configs(pki, *flags)
        assert refused.returncode == 2
        assert why in refused.stderr

    def test_an_empty_folder_is_refused(self, tmp_path):
        refused = make_configs(tmp_path)
        assert refused.returncode == 2
        assert "run make-ca.sh first" in refused.stderr


def includes(rule, key):
    return any(zenoh.KeyExpr(one).includes(zenoh.KeyExpr(key)) for one in rule["key_exprs"])


def test_every_test_that_the_threat_model_names_exists():
    tests = "".join(path.read_text(encoding="utf-8") for path in TLS.parents[1].glob("tests/**/test_*.py"))
    named = re.findall(r"`(test_\w+)`", (TLS.parent / "THREATS.md").read_text(encoding="utf-8"))
    assert len(named) > 10
    for name in named:
        assert f"def {name}(" in tests, f"THREATS.md refers to {name}, which is no test"
