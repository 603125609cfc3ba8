"""Certificates and Zenoh configurations for TLS on this machine, made by OpenSSL."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

_KEY = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
_ALL = ["put", "delete", "declare_subscriber", "liveliness_token", "declare_liveliness_subscriber"]


def make(folder: Path, *names: str) -> None:
    """Make a certificate authority, and a certificate and key for each name."""
    authority = ["-addext", "basicConstraints=critical,CA:TRUE", "-addext", "keyUsage=critical,keyCertSign"]
    _run(folder, "req", "-x509", *_KEY, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca", *authority)
    for name in names:
        _run(folder, "req", *_KEY, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        usage = "subjectAltName=DNS:localhost,IP:127.0.0.1\nextendedKeyUsage=serverAuth,clientAuth\n"
        (folder / f"{name}.ext").write_text(usage)
        signed = ["-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-extfile", f"{name}.ext"]
        _run(folder, "x509", "-req", "-in", f"{name}.csr", "-out", f"{name}.pem", *signed)


def config(folder: Path, name: str) -> Path:
    """Write the configuration of a program that shows the certificate of ``name``."""
    return _write(folder / f"{name}.json5", {"transport": {"link": {"tls": _tls(folder, name)}}})


def guarded(folder: Path, name: str, operator: str) -> Path:
    """Write the configuration of a daemon that accepts commands of ``operator`` only."""
    ask = ["query", "declare_queryable", "reply", "liveliness_query"]
    rules = [
        _rule("see", [*_ALL, "liveliness_query"], "**"),
        _rule("ask", ask, "skinnode/*/description/*"),
        _rule("command", ask, "skinnode/*/command/*"),
        {**_rule("answer", ["declare_queryable", "reply"], "**")},
    ]
    policies = [
        {"rules": ["see", "ask", "answer"], "subjects": ["anyone"]},
        {"rules": ["command"], "subjects": ["operator"]},
    ]
    subjects = [{"id": "anyone"}, {"id": "operator", "cert_common_names": [operator]}]
    access = {"enabled": True, "default_permission": "deny"}
    table = {"access_control": {**access, "rules": rules, "subjects": subjects, "policies": policies}}
    return _write(
        folder / "daemon.json5", {**table, "transport": {"link": {"tls": _tls(folder, name, listens=True)}}}
    )


def _rule(name: str, messages: list[str], key: str) -> dict[str, Any]:
    flows = ["ingress", "egress"]
    return {"id": name, "permission": "allow", "messages": messages, "flows": flows, "key_exprs": [key]}


def _tls(folder: Path, name: str, *, listens: bool = False) -> dict[str, Any]:
    kind = "listen" if listens else "connect"
    return {
        "root_ca_certificate": str(folder / "ca.pem"),
        f"{kind}_private_key": str(folder / f"{name}.key"),
        f"{kind}_certificate": str(folder / f"{name}.pem"),
        "enable_mtls": True,
    }


def _write(path: Path, table: dict[str, Any]) -> Path:
    path.write_text(json.dumps(table))
    return path


def _run(folder: Path, *command: str) -> None:
    subprocess.run(["openssl", *command], cwd=folder, check=True, capture_output=True)
