"""The README's programs run as they are printed, but for the size of the sweep and the tuning."""

import re
from pathlib import Path


README = Path(__file__).parents[2] / "README.md"


def test_the_readme_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    program = "\n".join(re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL))
    for large, small in (("1e4, 100)", "1e4, 2)"), ("steps=60", "steps=1")):
        assert large in program
        program = program.replace(large, small)
    names: dict = {}
    exec(program, names)
    assert names["result"][0].shape == (2, 2)
    assert float(capsys.readouterr().out.splitlines()[0]) < 1e-14
