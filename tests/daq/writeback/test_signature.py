"""Signatures: what minisign wrote is read, what we write has its layout,
and whatever is changed is noticed.
"""

from __future__ import annotations

import base64
import errno
import io
import json
import os
import shutil
import stat
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.cli.app import main
from daq.config.policy import parse_public_key
from daq.documents.calibration_file import save_calibration
from daq.errors import (
    CalibrationMissing,
    CalibrationRefused,
    ConfigurationInconsistent,
    OutputFailed,
    SignatureInvalid,
    UsageError,
    exit_code,
)
from daq.writeback import minisign
from daq.writeback.signature import generate, needs_password, sign, signature_path, signers_of
from tests.daq.calibrations import demo_calibration

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
CONTENT = b"drivegain\n"

# Made by minisign 0.11 of Debian: -G -W, then -S of a file with CONTENT; the last one with -l
# (legacy, not prehashed).
PUBLIC = "RWSIVoGC/VTYqNYUY9W0O5S777B4IqweO57qpzAPcdetGnbAICUCC7wp"
SECRET = (
    "untrusted comment: minisign encrypted secret key\n"
    "RWQAAEIyAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAiFaBgv1U2Ki+1WwvWfQufIoaoHXS5ESx5ESjgBnM"
    "ShD+Q94tI68xo9YUY9W0O5S777B4IqweO57qpzAPcdetGnbAICUCC7wpAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=\n"
)
SIGNATURE = (
    "untrusted comment: signature from minisign secret key\n"
    "RUSIVoGC/VTYqMvbh6xoISkbnebKugTpIBzFOWhfhGYXe5HNjJJ4akITJjTDUKT+DuNsvyq/y5KwqpbrbGLfWh5e99mhmlcipg0=\n"
    "trusted comment: made by minisign 0.11\n"
    "p8XFsQ2dHi+tjWtg4JjvFDdRrT/oxfTP9MujLQHMrBSC0R1It/ZF6btGTj9KMaw6E9XOHtPmjada2yJtlAJcBw==\n"
)
LEGACY = (
    "untrusted comment: signature from minisign secret key\n"
    "RWSIVoGC/VTYqIw4r/GcGUNzX4X3qhNdEl5a9nbFqi09Cf2+jqG+e8E5CEbWX7qf28FuwfjQ9Qpy3VFbmC/R2kmtsGNRGk/HnAQ=\n"
    "trusted comment: timestamp:1795293104\tfile:file.txt\n"
    "JjPBaWH3VzAtmm5Vns2PaKKlShgVkYprvgNwEP6tEIs191EGJGdLWaMVjVsTNtBNUlZngd0BmKE2/ainssLtDQ==\n"
)


def test_a_pipe_or_a_folder_in_place_of_a_file_keeps_no_one_waiting(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    file.write_bytes(CONTENT)
    secret, public = generate(tmp_path, "Bob")
    signature = signature_path(file, "Bob")
    for made in (os.mkfifo, os.mkdir):
        made(signature)
        with pytest.raises(SignatureInvalid, match=r"no regular file|is a directory"):
            signers_of(file, {"Bob": public.line})
        with pytest.raises(UsageError, match="no signature"):
            sign(file, secret, "Bob")
        signature.rmdir() if signature.is_dir() else signature.unlink()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(CalibrationMissing, match="no regular file"):
        sign(pipe, secret, "Bob")
    with pytest.raises(CalibrationMissing, match="no regular file"):
        signers_of(pipe, {"Bob": public.line})
    with pytest.raises(UsageError, match="no regular file"):
        sign(file, pipe, "Bob")
    signature.symlink_to("/dev/zero")
    with pytest.raises(SignatureInvalid, match="no regular file"):
        signers_of(file, {"Bob": public.line})


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    save_calibration(demo_calibration(), path)
    return path


def test_minisigns_own_files_are_read_and_written_alike() -> None:
    key = minisign.parse_secret_key(SECRET)
    assert key.public.line == PUBLIC
    assert parse_public_key(key.public.text) == key.public
    theirs = minisign.parse_signature(SIGNATURE)
    minisign.check_signature(key.public, theirs, CONTENT)
    # Ed25519 is deterministic: the same key, content and comment have one signature.
    assert key.sign(CONTENT, "made by minisign 0.11") == theirs
    lines = key.text("", b"").splitlines()
    expected = SECRET.splitlines()[1]
    assert lines[1] == expected
    assert theirs.text.splitlines()[1:] == SIGNATURE.splitlines()[1:]


@pytest.mark.parametrize(
    ("opslimit", "memlimit", "work", "parallel"),
    # libsodium's limits "sensitive" (of `minisign -G`), "interactive", and ours.
    [
        (33_554_432, 1_073_741_824, 2**20, 1),
        (524_288, 16_777_216, 2**14, 1),
        (2**22, 2**27, 2**17, 1),
    ],
)
def test_scrypts_parameters_are_picked_as_libsodium_does(
    opslimit: int, memlimit: int, work: int, parallel: int
) -> None:
    assert minisign._scrypt_parameters(opslimit, memlimit) == (work, parallel)


def test_a_signature_beside_the_file_is_found(calibration: Path) -> None:
    folder = calibration.parent / "keys"
    secret, public = generate(folder, "anna")
    keys_folder = calibration.parent / "keys"
    _, other = generate(keys_folder, "bert")
    trusted = {"bert": other.line, "anna": public.line}
    assert signers_of(calibration, trusted) == ()
    path = sign(calibration, secret, "anna", at=NOW)
    assert path == signature_path(calibration, "anna")
    assert signers_of(calibration, trusted) == ("anna",)
    signature = minisign.parse_signature(path.read_text())
    reported = signature.comment.split("\t")
    expected = [
        "timestamp:1735787045",
        "at:2025-01-02T03:04:05+00:00",
        "file:calibration.yaml",
        "signer:anna",
        "hashed",
    ]
    assert reported == expected


def test_an_untrusted_signer_is_not_considered(calibration: Path) -> None:
    secret, _ = generate(calibration.parent, "mallory")
    sign(calibration, secret, "mallory", at=NOW)
    signature_path(calibration, "someone").write_text("nonsense")
    _, public = generate(calibration.parent, "anna")
    trusted = {"anna": public.line}
    assert signers_of(calibration, trusted) == ()


@settings(max_examples=60, deadline=None)
@given(place=st.integers(min_value=0), bit=st.integers(0, 7))
def test_every_changed_bit_of_the_content_is_noticed(place: int, bit: int) -> None:
    key = minisign.parse_secret_key(SECRET)
    changed = bytearray(CONTENT)
    changed[place % len(CONTENT)] ^= 1 << bit
    signature = minisign.parse_signature(SIGNATURE)
    with pytest.raises(ValueError, match="other content"):
        minisign.check_signature(key.public, signature, bytes(changed))


@settings(max_examples=200, deadline=None)
@given(
    place=st.integers(0, len(SIGNATURE) - 1),
    letter=st.characters(min_codepoint=1, max_codepoint=0x17F),
)
def test_a_changed_letter_of_a_signature_is_noticed_or_means_nothing(
    place: int, letter: str
) -> None:
    """Behind "untrusted comment: " any text is allowed;
    the last letters of a base64 text have meaningless bits.
    """
    changed = SIGNATURE[:place] + letter + SIGNATURE[place + 1 :]
    public = parse_public_key(PUBLIC)
    try:
        read = minisign.parse_signature(changed)
        minisign.check_signature(public, read, CONTENT)
    except ValueError:
        return
    assert read == minisign.parse_signature(SIGNATURE)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(
    st.text(max_size=300) | st.binary(max_size=200).map(lambda raw: base64.b64encode(raw).decode())
)
def test_what_is_no_key_and_no_signature_is_reported_and_never_trusted(text: str) -> None:
    for parse in (parse_public_key, minisign.parse_secret_key, minisign.parse_signature):
        with pytest.raises(ValueError, match=r".+"):
            parse(text)


@pytest.mark.parametrize(
    "broken", ["content", "comment", "signature", "copied", "legacy", "folder", "empty"]
)
def test_a_trusted_persons_signature_that_does_not_fit_is_an_error(
    calibration: Path, broken: str
) -> None:
    secret, public = generate(calibration.parent, "anna")
    other, _ = generate(calibration.parent, "bert")
    path = sign(calibration, secret, "anna", at=NOW)
    match broken:
        case "content":
            calibration.write_bytes(calibration.read_bytes() + b"\n")
        case "comment":
            path.write_text(path.read_text().replace("signer:anna", "signer:bert"))
        case "signature":
            path.write_text(path.read_text().replace("trusted comment", "trusted Comment"))
        case "copied":
            shutil.copyfile(sign(calibration, other, "bert", at=NOW), path)
        case "legacy":
            path.write_text(LEGACY)
        case "folder":
            path.unlink()
            path.mkdir()
        case "empty":
            path.write_bytes(b"")
    with pytest.raises(SignatureInvalid) as refused:
        signers_of(calibration, {"anna": public.line})
    assert exit_code(SignatureInvalid) == 3
    assert issubclass(SignatureInvalid, CalibrationRefused)
    assert "anna" in refused.value.expected


def test_what_was_read_is_what_is_checked(calibration: Path) -> None:
    secret, public = generate(calibration.parent, "anna")
    sign(calibration, secret, "anna", at=NOW)
    read = calibration.read_bytes()
    calibration.write_bytes(b"exchanged after it was read")
    trusted = {"anna": public.line}
    assert signers_of(calibration, trusted, read) == ("anna",)
    with pytest.raises(SignatureInvalid):
        signers_of(calibration, {"anna": public.line})


def test_two_names_with_one_key_are_no_two_persons(calibration: Path) -> None:
    _, public = generate(calibration.parent, "anna")
    trusted = {"anna": public.line, "bert": public.line}
    with pytest.raises(ConfigurationInconsistent, match="the key of anna"):
        signers_of(calibration, trusted)


@pytest.mark.parametrize(
    "trusted", [{"anna": "no key"}, {"../anna": PUBLIC}, {"": PUBLIC}, {"anna": PUBLIC[:-4]}]
)
def test_a_public_key_that_is_none_is_the_configurations_fault(
    calibration: Path, trusted: dict[str, str]
) -> None:
    with pytest.raises(ConfigurationInconsistent, match="trusted signer"):
        signers_of(calibration, trusted)


def test_a_secret_key_is_its_owners_alone_and_never_replaced(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        secret, public = generate(tmp_path, "anna")
    finally:
        os.umask(old)
    st_mode = secret.stat().st_mode
    assert stat.S_IMODE(st_mode) == 0o600
    before = secret.read_bytes()
    with pytest.raises(UsageError, match="keys are not replaced"):
        generate(tmp_path, "anna")
    secret.unlink()
    # The public key alone: a cell file may name it already.
    with pytest.raises(UsageError, match="keys are not replaced"):
        generate(tmp_path, "anna")
    assert not secret.exists()
    secret.write_bytes(before)
    text = secret.with_suffix(".pub").read_text()
    assert public.line in text
    secret_key = minisign.parse_secret_key(before.decode())
    assert "seed" not in repr(secret_key)


@pytest.mark.parametrize("full_at", [1, 2])
def test_a_full_disk_leaves_no_half_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full_at: int
) -> None:
    synced: list[int] = []

    def fill(descriptor: int) -> None:
        synced.append(descriptor)
        if len(synced) == full_at:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", fill)
        with pytest.raises(OutputFailed):
            generate(tmp_path, "anna")
    assert list(tmp_path.iterdir()) == []
    secret, _ = generate(tmp_path, "anna")
    assert needs_password(secret) is False


@pytest.mark.slow
def test_a_key_without_a_password_that_others_may_read_signs_nothing(calibration: Path) -> None:
    secret, _ = generate(calibration.parent, "anna")
    secret.chmod(0o640)
    with pytest.raises(UsageError, match="chmod 600"):
        sign(calibration, secret, "anna")
    locked, public = generate(calibration.parent, "bert", "a password")
    locked.chmod(0o644)  # as on a stick without rights
    sign(calibration, locked, "bert", password="a password")
    trusted = {"bert": public.line}
    assert signers_of(calibration, trusted) == ("bert",)


@pytest.mark.slow
def test_a_password_protects_the_key(calibration: Path) -> None:
    secret, public = generate(calibration.parent, "anna", "grüne Bohne")
    assert needs_password(secret)
    assert parse_public_key(public.text).key not in base64.b64decode(
        secret.read_text().splitlines()[1]
    )
    for wrong in ("", "grüne bohne"):
        with pytest.raises(UsageError, match="a secret key of"):
            sign(calibration, secret, "anna", password=wrong)
    assert not signature_path(calibration, "anna").exists()
    sign(calibration, secret, "anna", password="grüne Bohne")
    trusted = {"anna": public.line}
    assert signers_of(calibration, trusted) == ("anna",)


def test_a_key_that_asks_for_too_much_memory_is_refused() -> None:
    packed = bytearray(base64.b64decode(SECRET.splitlines()[1]))
    packed[2:4] = b"Sc"
    packed[38:54] = (2**30).to_bytes(8, "little") + (2**40).to_bytes(8, "little")
    text = base64.b64encode(packed).decode()
    with pytest.raises(ValueError, match="asks for"):
        minisign.parse_secret_key(text, "password")


@pytest.mark.parametrize("name", ["", "../anna", "a/b", ".hidden", "a b", "a\n", "x" * 65])
def test_a_name_is_part_of_a_file_name(calibration: Path, name: str) -> None:
    with pytest.raises(UsageError):
        generate(calibration.parent, name)
    with pytest.raises(UsageError):
        sign(calibration, calibration, name)


def test_whatever_is_not_there_or_in_the_way_is_reported(calibration: Path) -> None:
    secret, public = generate(calibration.parent, "anna")
    missing_path = calibration.parent / "missing.key"
    for absent in (missing_path, secret.with_suffix(".pub")):
        with pytest.raises(UsageError, match="a secret key of"):
            sign(calibration, absent, "anna")
    file = calibration.parent / "none.yaml"
    with pytest.raises(CalibrationMissing):
        sign(file, secret, "anna")
    none_path = calibration.parent / "none.yaml"
    with pytest.raises(CalibrationMissing):
        signers_of(none_path, {"anna": public.line})
    signature_path(calibration, "anna").write_text("my notes")
    with pytest.raises(UsageError, match="no signature"):
        sign(calibration, secret, "anna")
    with pytest.raises(OutputFailed):
        generate(calibration / "below a file", "bert")


@pytest.mark.slow
def test_the_verbs_make_a_key_sign_and_check(
    calibration: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = str(calibration.parent / "keys")
    assert (
        main(["sign", "key", "--name", "anna", "--folder", folder, "--no-password", "--json"]) == 0
    )
    made = json.loads(capsys.readouterr().out)
    signed = [
        "sign",
        "calibration",
        str(calibration),
        "--key",
        made["secret_key"],
        "--name",
        "anna",
    ]
    assert main(signed) == 0
    out = capsys.readouterr().out
    assert "J4" in out
    assert "calibration.yaml.anna.minisig" in "".join(out.split())
    trusted = {"anna": made["public_key"]}
    assert signers_of(calibration, trusted) == ("anna",)
    monkeypatch.setattr("sys.stdin", io.StringIO("secret\n"))
    assert main(["sign", "key", "--name", "bert", "--folder", folder]) == 0
    monkeypatch.setattr("sys.stdin", io.StringIO("other\n"))
    assert main([*signed[:4], f"{folder}/bert.key", "--name", "bert"]) == 2
    changed_content = calibration.read_bytes().replace(b"ml", b"ls", 1)
    calibration.write_bytes(changed_content)
    assert main(signed) == 3  # a calibration that was edited is not signed


def test_check_names_the_signers_of_the_cell(
    calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret, public = generate(calibration.parent, "anna")
    cell = calibration.parent / "cells" / "demo.yaml"
    configs_folder = Path(__file__).parents[3] / "configs"
    shutil.copytree(configs_folder, calibration.parent, dirs_exist_ok=True)
    text = cell.read_text()
    assert "\npolicy:" not in text
    cell.write_text(
        f"{text}\npolicy: {{apply: {{signatures: 1, signers: {{anna: {public.line}}}}}}}\n"
    )
    check = ["sign", "check", str(calibration), "--cell", str(cell)]
    assert main([*check, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document == {"signers": [], "signatures_needed": 1}
    sign(calibration, secret, "anna", at=NOW)
    assert main(check) == 0
    assert "Signed by: anna." in capsys.readouterr().out
    calibration.write_bytes(calibration.read_bytes() + b"\n")
    assert main(check) == 3


@pytest.mark.skipif(shutil.which("minisign") is None, reason="minisign is not installed")
def test_the_real_minisign_verifies_ours(calibration: Path) -> None:
    secret, public = generate(calibration.parent, "anna")
    path = sign(calibration, secret, "anna", at=NOW)
    verify = ["minisign", "-V", "-H", "-m", str(calibration), "-x", str(path), "-P", public.line]
    completed = subprocess.run(verify, capture_output=True, check=False)
    assert completed.returncode == 0
    calibration.write_bytes(b"changed")
    assert subprocess.run(verify, capture_output=True, check=False).returncode == 1


def test_line_ends_of_another_system_do_not_change_a_signature() -> None:
    text = SIGNATURE.replace("\n", "\r\n")
    windows = minisign.parse_signature(text)
    assert windows == minisign.parse_signature(SIGNATURE)
    minisign.check_signature(parse_public_key(PUBLIC), windows, CONTENT)
    changed_signature = SIGNATURE.replace("\n", "\r")
    with pytest.raises(ValueError, match="four lines"):
        minisign.parse_signature(changed_signature)
