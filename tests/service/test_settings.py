"""Settings: from the environment, checked before anything runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.settings import MIB, Settings, SettingsError, read_settings, unknown_variables


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    for name in list(os.environ):
        if name.startswith("PLACEREC_"):
            monkeypatch.delenv(name)


def test_defaults() -> None:
    settings = read_settings()
    assert (settings.host, settings.port, settings.data_dir) == ("127.0.0.1", 8000, Path("data"))
    assert settings.models_directory == Path("data").absolute().parent / "models"
    assert settings.max_image_bytes == 16 * MIB
    assert settings.encoder == "m-region-vlad"


def test_the_environment_decides(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PLACEREC_PORT", "9000")
    monkeypatch.setenv("PLACEREC_DATA_DIR", str(tmp_path / "kept"))
    monkeypatch.setenv("PLACEREC_REQUEST_TIMEOUT", "2.5")
    settings = read_settings()
    assert (settings.port, settings.request_timeout) == (9000, 2.5)
    assert settings.models_directory == tmp_path / "models"


def test_each_wrong_value_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACEREC_PORT", "99999")
    monkeypatch.setenv("PLACEREC_QUEUE_LENGTH", "many")
    monkeypatch.setenv("PLACEREC_REQUEST_TIMEOUT", "nan")
    with pytest.raises(SettingsError) as raised:
        read_settings()
    lines = str(raised.value).splitlines()
    assert [line.split(":")[0] for line in lines] == [
        "PLACEREC_PORT",
        "PLACEREC_QUEUE_LENGTH",
        "PLACEREC_REQUEST_TIMEOUT",
    ]


def test_limits_must_fit_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACEREC_MAX_IMAGE_BYTES", str(200 * MIB))
    with pytest.raises(SettingsError, match="MAX_BATCH_BYTES is less than PLACEREC_MAX_IMAGE_BYTES"):
        read_settings()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost", "127.8.8.8"])
def test_loopback_is_served_without_keys(host: str) -> None:
    Settings(host=host).check_exposure()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.4", "robots.example"])
def test_other_machines_are_not(host: str) -> None:
    with pytest.raises(SettingsError, match="PLACEREC_ALLOW_ANONYMOUS=true"):
        Settings(host=host).check_exposure()
    Settings(host=host, allow_anonymous=True).check_exposure()
    Settings(host=host).check_exposure(has_keys=True)


def test_a_typing_error_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PLACEREC_QUEUE_LENGHT", "1")
    monkeypatch.setenv("PLACEREC_PORT", "1")
    monkeypatch.setenv("PLACEREC_URL", "http://robot")
    assert unknown_variables() == ["PLACEREC_QUEUE_LENGHT"]


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("MAX_IMPORT_BYTES", "100"),
        ("MAX_IMPORTS", "0"),
        ("IMPORT_TIMEOUT", "inf"),
        ("MAX_EXPORTS", "0"),
        ("EXPORT_SECONDS", "0"),
    ],
)
def test_limits_of_map_files(monkeypatch: pytest.MonkeyPatch, name: str, bad: str) -> None:
    monkeypatch.setenv(f"PLACEREC_{name}", bad)
    with pytest.raises(SettingsError, match=f"^PLACEREC_{name}: "):
        read_settings()


@pytest.mark.parametrize("address", ["", "mysql://u:p@h/d", "postgres//x", "db"])
def test_addresses_of_no_database(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setenv("PLACEREC_DATABASE", address)
    with pytest.raises(SettingsError, match="PLACEREC_DATABASE is not an address such as postgresql://") as refused:
        read_settings()
    assert "u:p" not in str(refused.value)


@pytest.mark.parametrize("address", ["postgresql://placerec:word@db/placerec", "host=db dbname=placerec"])
def test_addresses_of_a_database(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setenv("PLACEREC_DATABASE", address)
    found = read_settings().database
    assert found is not None and found.get_secret_value() == address


def test_a_file_is_no_folder_for_backups(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "saved").write_text("")
    monkeypatch.setenv("PLACEREC_BACKUP_DIR", str(tmp_path / "saved"))
    with pytest.raises(SettingsError, match="PLACEREC_BACKUP_DIR is no folder"):
        read_settings()
    monkeypatch.setenv("PLACEREC_BACKUP_DIR", str(tmp_path / "made-when-it-is-needed"))
    assert read_settings().backup_dir == tmp_path / "made-when-it-is-needed"
