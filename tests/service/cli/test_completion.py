"""neurove completion: the scripts complete commands in the shells themselves."""

import shutil
import subprocess

import pytest


def completed(script, words):
    """What bash offers for the last word."""
    ask = f"""
{script}
COMP_WORDS=({" ".join(words)}); COMP_CWORD={len(words) - 1}; COMP_LINE="{" ".join(words)}"; COMP_POINT=${{#COMP_LINE}}
COMPREPLY=()
$(complete -p neurove | sed 's/.*-F \\([^ ]*\\).*/\\1/') neurove "{words[-1]}" "{words[-2]}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    ran = subprocess.run(["bash", "--norc", "-c", ask], capture_output=True, text=True, check=True)
    return ran.stdout.split()


@pytest.mark.skipif(not shutil.which("bash"), reason="bash is not installed")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["neurove", "hea"], ["health"]),
        (["neurove", "bundle", "si"], ["sign"]),
        (["neurove", "drive", "--spe"], ["--speed"]),
        (["neurove", "completion", "z"], ["zsh"]),
    ],
)
def test_bash_completes_commands_and_flags(run, words, offered):
    code, script, err = run("completion", "bash")
    assert (code, err) == (0, "")
    assert completed(script, words) == offered


def test_the_script_for_zsh_is_printed_and_valid(run, tmp_path):
    code, script, err = run("completion", "zsh")
    assert (code, err) == (0, "")
    assert script.startswith("#compdef neurove")
    assert "health" in script
    if shutil.which("zsh"):
        (tmp_path / "_neurove").write_text(script)
        subprocess.run(["zsh", "-n", str(tmp_path / "_neurove")], check=True)
