"""The page and its requests:

    GET    /                                the page; page.js and page.css beside it
    GET    /api/jobs                        what can be chosen, limits, and the jobs that are kept
    POST   /api/jobs                        {system, files: [{name, size}]}: a new job
    PUT    /api/jobs/ID/logs/K              the K-th log, its bytes as they are
    POST   /api/jobs/ID/inspect             {system, mapping}: look into the logs
    POST   /api/jobs/ID/diagnose, cancel    start, stop
    DELETE /api/jobs/ID                     remove it with its files
    GET    /api/jobs/ID                     all that the page shows of it
    GET    /jobs/ID/FILE                    report.html, effects.yaml, diagnosis.json, mapping.yaml, log.txt, a picture

What is under `/api` needs the token. Files of a job need its id, which nobody can guess and only `/api` returns.
"""

import hmac
import json
import socket
import sys
import traceback
from collections.abc import Callable, Collection, Iterable
from dataclasses import KW_ONLY, asdict, dataclass
from importlib import resources
from typing import Any

from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser
from waitress.server import create_server
from waitress.utilities import Error
from werkzeug.exceptions import HTTPException
from werkzeug.routing import Map, Rule
from werkzeug.wrappers import Request, Response

from nsde_torch.diagnosis.time_series import script_hash
from nsde_torch.errors import ConfigError

from .job import FORMATS, STATES, RefusedError, ServedJob, receive
from .runner import INSPECTION, LOG, MAPPING, JobRunner
from .summary import RESULT, SUMMARY

_STATIC = ("index.html", "page.js", "views.js", "page.css", "icon.svg")
_LARGEST = 1 << 18  # bytes of a request that is no log
_COLUMNS = 300  # that are listed
_HOMES = {**dict.fromkeys(("report.html", "effects.yaml", "diagnosis.json"), RESULT), MAPPING: "", LOG: ""}
"""Files of a job that may be read -> folder in it."""


@dataclass(eq=False)
class ServedPage:
    """The application, as WSGI calls it."""

    runner: JobRunner  # works on the jobs
    _: KW_ONLY
    token: str  # what requests must hold
    hosts: Collection[str]  # `name:port` of this server

    def __post_init__(self) -> None:
        self._shelf = self.runner.shelf
        job = "/api/jobs/<name>"
        answers: list[tuple[str, str, Callable[..., Response]]] = [
            ("GET", "/", self._page),
            ("GET", "/<file>", self._page),
            ("GET", "/api/jobs", self._list),
            ("POST", "/api/jobs", self._create),
            ("GET", job, self._show),
            ("DELETE", job, self._delete),
            ("PUT", f"{job}/logs/<int:index>", self._receive),
            ("POST", f"{job}/inspect", self._inspect),
            ("POST", f"{job}/<any(diagnose, cancel):what>", self._do),
            ("GET", "/jobs/<name>/<file>", self._file),
        ]
        self._map = Map([Rule(path, endpoint=answer, methods=[method]) for method, path, answer in answers])

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        request = Request(environ)
        answer = self._answer(request)
        policy = _SHEET if request.path.startswith("/jobs/") else _PAGE
        answer.headers.update({**_SHUT_IN, "Content-Security-Policy": policy})
        return answer(environ, start_response)

    def _answer(self, request: Request) -> Response:
        try:
            check_place(request, self.hosts)
            if request.path.startswith("/api/") and not is_token(request.headers.get(TOKEN, ""), self.token):
                raise RefusedError(NO_TOKEN, 401)
            answer, values = self._map.bind_to_environ(request.environ).match()
            made: Response = answer(request, **values)
            return made
        except RefusedError as error:
            return answer_json({"error": str(error)}, error.status)
        except HTTPException as error:
            return answer_json(
                {"error": f"{error.name}: there is nothing of this kind here."}, error.code or 404
            )
        except Exception:  # a fault of ours: the terminal has it, the page a sentence
            traceback.print_exc(file=sys.stderr)
            return answer_json({"error": "The page has a fault; the terminal of `nsde serve` shows it."}, 500)

    def _page(self, request: Request, file: str = "index.html") -> Response:
        if file not in _STATIC:
            raise RefusedError("There is nothing of this name here.", 404)
        content = resources.files("nsde_torch.cli.serving").joinpath("page", file).read_bytes()
        return Response(content, content_type=TYPES[f".{file.rpartition('.')[2]}"])

    def _list(self, request: Request) -> Response:
        limits = self.runner.limits
        return answer_json(
            {
                "systems": list(self.runner.machines.names),
                "system": self.runner.machines.first,
                "suffixes": list(FORMATS),
                "upload": limits.upload,
                "files": limits.files,
                "seconds": limits.seconds,
                "folder": str(self._shelf.folder),
                "jobs": [self._brief(job) for job in self._shelf.all()],
            }
        )

    def _create(self, request: Request) -> Response:
        given = _content(request)
        system, files = given.get("system") or None, given.get("files")
        if system is not None and system not in self.runner.machines.names:
            raise RefusedError("Choose one of the systems of the list.")
        if not isinstance(files, list) or not all(
            isinstance(f, dict) and isinstance(f.get("name"), str) and type(f.get("size")) is int
            for f in files
        ):
            raise RefusedError("`files` must hold the name and the size of each log.")
        job = self._shelf.create([(f["name"], f["size"]) for f in files], system)
        return answer_json(self._brief(job), 201)

    def _receive(self, request: Request, name: str, index: int) -> Response:
        job = self._shelf.get(name)
        with self._shelf.lock:
            if job.state != "uploading" or index >= len(job.files) or job.files[index].there:
                raise RefusedError("This log is not expected.", 409)
            file = job.files[index]
        try:
            receive(request.stream.read, self._shelf.of(job) / "logs" / file.name, file.size)
        except RefusedError:
            self._shelf.delete(job)
            raise
        file.there = True
        self._shelf.note(job)
        return answer_json(self._brief(job))

    def _inspect(self, request: Request, name: str) -> Response:
        job, given = self._shelf.get(name), _content(request)
        system, mapping = given.get("system") or None, given.get("mapping") or None
        if not isinstance(system, str | None) or not isinstance(mapping, str | None):
            raise RefusedError("`system` and `mapping` must be text.")
        self.runner.inspect(job, system=system, mapping=mapping)
        return self._show(request, name)

    def _do(self, request: Request, name: str, what: str) -> Response:
        (self.runner.diagnose if what == "diagnose" else self.runner.cancel)(self._shelf.get(name))
        return self._show(request, name)

    def _delete(self, request: Request, name: str) -> Response:
        self._shelf.delete(self._shelf.get(name))
        return answer_json({})

    def _show(self, request: Request, name: str) -> Response:
        job = self._shelf.get(name)
        with self._shelf.lock:
            content = {**asdict(job), **self._brief(job)}
        found = self._shelf.read(job, INSPECTION)
        if found is not None:
            content["inspection"] = {**found, "columns": _first(found), "all_columns": len(found["columns"])}
        folder = self._shelf.of(job)
        mapping = folder / MAPPING
        content["mapping"] = mapping.read_text(encoding="utf-8") if mapping.is_file() else ""
        if job.state == "done":
            content["summary"] = self._shelf.read(job, SUMMARY)
        content["printed"] = (folder / LOG).is_file()
        return answer_json(content)

    def _file(self, request: Request, name: str, file: str) -> Response:
        job = self._shelf.get(name)
        folder = self._shelf.of(job)
        pictures = {path.name: path for path in (folder / RESULT / "plots").glob("*.png")}
        path = folder / _HOMES[file] / file if file in _HOMES else pictures.get(file)
        if path is None or not path.is_file():
            raise RefusedError("There is no such file.", 404)
        answer = Response(path.read_bytes(), content_type=TYPES[path.suffix])
        if "save" in request.args:
            answer.headers["Content-Disposition"] = f'attachment; filename="{file}"'
        return answer

    def _brief(self, job: ServedJob) -> dict[str, Any]:
        return {
            **{key: getattr(job, key) for key in ("id", "created", "system", "machine", "state")},
            "files": [{"given": f.given, "name": f.name, "size": f.size} for f in job.files],
            "called": STATES[job.state],
            "seconds": self.runner.elapsed(job),
        }


def _content(request: Request) -> dict[str, Any]:
    if request.mimetype != "application/json":  # what a form of another site can send
        raise RefusedError("The request must be JSON.", 415)
    raw = request.stream.read(_LARGEST + 1)
    if len(raw) > _LARGEST:
        raise RefusedError("The request is too large.", 413)
    try:
        content = json.loads(raw)
    except (ValueError, RecursionError):
        content = None
    if not isinstance(content, dict):
        raise RefusedError("The request must be a JSON object.")
    return content


def _first(found: dict[str, Any]) -> list[dict[str, Any]]:
    """Columns that the mapping uses first, then those that move."""
    used = set(found["mapped"])

    def place(row: dict[str, Any]) -> int:
        full = f"{row['stream']}/{row['column']}"
        return 0 if row["column"] in used or full in used else 1 if row["low"] != row["high"] else 2

    return sorted(found["columns"], key=place)[:_COLUMNS]


# --- answers: JSON, files, and the headers that keep a browser from doing more with them than show them ---------------

_PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SHEET = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    f"script-src '{script_hash()}'; sandbox allow-scripts; frame-ancestors 'self'"
)
"""A report runs the script of its time series and no other, and can ask for nothing."""
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".yaml": "text/plain; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
}


def answer_json(content: Any, status: int = 200) -> Response:
    return Response(json.dumps(content), status=status, content_type=TYPES[".json"])


_SHUT_IN = {
    **{"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store"},
    **dict.fromkeys(("Cross-Origin-Resource-Policy", "Cross-Origin-Opener-Policy"), "same-origin"),
}
"""Headers of every answer: nothing from elsewhere, nothing kept, no frame of another site."""


# Who may ask: pages of this server alone, under its own name, with its token.
#
# A page of another site can make a browser send requests to this machine. It cannot read the answers, but it
# could start work, and under a name of its own that leads here (DNS rebinding) it could read them too. So the
# names of the server are checked, where a request comes from, and the token, which is only in the address
# that the command prints.

TOKEN = "X-Nsde-Token"  # header that holds the token
NO_TOKEN = "Open the address that `nsde serve` printed: it holds the key to this page."
_SAFE = ("GET", "HEAD")
_OWN = (None, "same-origin", "none")


def check_place(request: Request, hosts: Collection[str]) -> None:
    """Refuse requests under another name than `hosts`, or from the page of another site."""
    if request.headers.get("Host") not in hosts:
        raise RefusedError(f"This page is at {sorted(hosts)[0]} alone.", 421)
    origin = request.headers.get("Origin")
    if origin is not None and origin not in {f"http://{host}" for host in hosts}:
        raise RefusedError("Requests of other sites are refused.", 403)
    page = request.method in _SAFE and request.path == "/"
    if not page and request.headers.get("Sec-Fetch-Site") not in _OWN:
        raise RefusedError("Requests of other sites are refused.", 403)


def is_token(given: str, token: str) -> bool:
    """Whether what a request holds is the token; the time that this takes says nothing of it."""
    return hmac.compare_digest(given.encode(), token.encode())


# The server of the application: waitress on an address of this machine.
#
# waitress takes the whole body of a request before it calls the application. So the parser of requests asks for the
# token as soon as it has the header: a body without it is not read.

WSGI = Callable[[Any, Any], Iterable[bytes]]


class _KeylessError(Error):
    """The answer to a body without the token."""

    code, reason = 401, "Unauthorized"

    def to_response(self, ident: str | None = None) -> tuple[str, list[tuple[str, str]], bytes]:
        headers = [("Content-Type", "application/json")]
        return f"{self.code} {self.reason}", headers, json.dumps({"error": self.body}).encode()


def _channel(token: str) -> type[HTTPChannel]:
    """A connection that reads no body without the token."""

    class Parser(HTTPRequestParser):
        error: Error | None = None

        def received(self, data: bytes) -> int:
            before = self.headers_finished
            consumed: int = super().received(data)
            if self.headers_finished and not before and self.body_rcv is not None and self.error is None:
                given = self.headers.get(TOKEN.upper().replace("-", "_"), "")
                if not is_token(given, token):
                    self.error, self.completed, self.expect_continue = _KeylessError(NO_TOKEN), True, False
            return consumed

    class Channel(HTTPChannel):
        parser_class = Parser

    return Channel


def serve(sock: socket.socket, application: WSGI, *, token: str, largest: int, threads: int) -> None:
    """Answer requests of `largest` bytes at most, until Ctrl-C or SIGTERM."""
    server = create_server(
        application,
        sockets=[sock],
        threads=threads,
        max_request_body_size=largest,
        clear_untrusted_proxy_headers=True,
        ident=None,
    )
    server.channel_class = _channel(token)
    try:
        server.run()
    finally:
        server.close()


def listen(host: str, port: int) -> socket.socket:
    """Bind a port, 0 for any that is free; ConfigError where it is taken, or may not be bound."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((host, port))
        sock.listen()  # from here on a browser waits, though nothing answers yet
    except OSError as error:
        sock.close()
        raise ConfigError(
            f"`port`: {host}:{port} cannot be bound ({error.strerror}); another page may run there: port=0 takes any "
            "that is free."
        ) from error
    return sock
