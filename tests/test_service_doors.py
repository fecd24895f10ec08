"""The doors of the service: what keeps a server from opening them, and what it says to those who do not come in."""

from __future__ import annotations

from pathlib import Path

import pytest
from zmq.auth import load_certificate

from handmap_qp import cli
from handmap_qp.errors import InvalidInputError
from handmap_qp.service.keys import ClientKeys, make_keys, read_server_keys, read_token


def complaint(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """What the command line says of words that it refuses."""
    assert cli.main([str(word) for word in words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


# -- keys and tokens ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [b"", b"garbage", b'    public-key = "a"\n    secret-key = "b"\n', bytes(range(256))], ids=repr)
def test_a_file_that_is_no_key_is_to_be_deleted_first(tmp_path: Path, text: bytes) -> None:
    make_keys(tmp_path, ["a"])
    (tmp_path / "server.key_secret").write_bytes(text)
    with pytest.raises(InvalidInputError, match=r"server.key_secret: expected a server's secret key, .* delete it"):
        read_server_keys(tmp_path)
    (tmp_path / "server.key_secret").unlink()
    with pytest.raises(InvalidInputError, match=f"is not there; handmap keys {tmp_path} makes it"):
        read_server_keys(tmp_path)
    make_keys(tmp_path, [])
    assert len(read_server_keys(tmp_path).secret) == 40


def test_a_client_that_was_shut_out_is_admitted_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["keys", str(tmp_path), "--client", "a"]
    assert cli.main(words) == 0
    keys, a = ClientKeys(tmp_path / "clients"), load_certificate(tmp_path / "a.key")[0]
    (tmp_path / "clients" / "a.key").unlink()
    assert not keys.callback("*", a)
    capsys.readouterr()
    assert cli.main(words) == 0
    assert capsys.readouterr().out == f"wrote {tmp_path}/clients/a.key, which admits a again\n"
    assert keys.callback("*", a)
    assert cli.main(words) == 0
    assert capsys.readouterr().out == "wrote nothing: all keys are there\n"


def test_names_of_clients_are_checked_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"'\.\./bad'"):
        make_keys(tmp_path / "keys", ["good", "../bad"])
    assert not (tmp_path / "keys").exists()


def test_a_file_in_place_of_the_folder_of_keys_is_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    for use in (read_server_keys, lambda folder: make_keys(folder, ["a"])):
        with pytest.raises(InvalidInputError, match="file: expected a folder of keys"):
            use(file)


def test_a_token_is_for_its_owner_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "token"
    file.write_text("a-token-of-the-tests\n", encoding="utf-8")
    file.chmod(0o640)
    assert "token: others can read it; chmod 600" in complaint(capsys, "serve", "--web", "--web-token-file", file)
    file.chmod(0o600)
    assert read_token(file) == "a-token-of-the-tests"
    file.write_bytes(b"\xff\xfe")
    assert "token: cannot be read" in complaint(capsys, "serve", "--web", "--web-token-file", file)


def test_a_key_that_is_refused_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, object]] = []
    monkeypatch.setattr("handmap_qp.service.logs.report", lambda level, event, **data: told.append((event, data["key"])))
    make_keys(tmp_path, ["a", "b"])
    (tmp_path / "clients" / "b.key").unlink()
    a, b = (load_certificate(tmp_path / f"{name}.key")[0] for name in "ab")
    keys = ClientKeys(tmp_path / "clients")
    # Of those that come at once, the first is told.
    for key in (a, b, b):
        keys.callback("*", key)
    assert told == [("refused_key", b.decode())]
