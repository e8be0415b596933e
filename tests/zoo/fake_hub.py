"""A hub on this machine: the part of the Hugging Face hub's HTTP interface that uploads and downloads of models use."""

import base64
import contextlib
import hashlib
import json
import threading
from collections.abc import Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class FakeHub(ThreadingHTTPServer):
    """Repositories as lists of commits, each the content of all files by path.

    Attributes:
        commits: By repository, the oid and files of each commit, the last one being `main`.
        private: Repositories that only requests with a token see.
        cut: Files of which a download ends after half of its bytes.
        requests: Method and path of each request.
    """

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.commits: dict[str, list[tuple[str, dict[str, bytes]]]] = {}
        self.private: set[str] = set()
        self.cut: set[str] = set()
        self.requests: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def files(self, repository: str, revision: str) -> tuple[str, dict[str, bytes]] | None:
        commits = self.commits.get(repository, [])
        if revision == "main" and commits:
            return commits[-1]
        return next((commit for commit in commits if commit[0] == revision), None)

    def commit(self, repository: str, changed: dict[str, bytes], deleted: Iterable[str] = ()) -> str:
        commits = self.commits[repository]
        files = (commits[-1][1] if commits else {}) | changed
        files = {path: content for path, content in files.items() if path not in deleted}
        oid = hashlib.sha1(f"{len(commits)}{sorted(files)}".encode(), usedforsecurity=False).hexdigest()
        commits.append((oid, files))
        return oid


class Handler(BaseHTTPRequestHandler):
    server: FakeHub

    def log_message(self, *_) -> None:
        pass

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        path = self.path.partition("?")[0]
        self.server.requests.append(f"POST {path}")
        if path == "/api/repos/create":
            asked = json.loads(content)
            name = f"{asked['organization']}/{asked['name']}" if asked.get("organization") else asked["name"]
            if name in self.server.commits:
                return self._answer({"error": "exists", "url": f"{self.server.url}/{name}"}, 409)
            self.server.commits[name] = []
            self.server.commit(name, {".gitattributes": b""})  # as the hub does
            if asked.get("private") or asked.get("visibility") == "private":
                self.server.private.add(name)
            return self._answer({"url": f"{self.server.url}/{name}"})
        if path == "/api/validate-yaml":
            return self._answer({"errors": [], "warnings": []})
        repository, action = "/".join(path.split("/")[3:5]), path.split("/")[5]
        if action == "preupload":
            files = json.loads(content)["files"]
            return self._answer(
                {"files": [{"path": f["path"], "uploadMode": "regular", "shouldIgnore": False} for f in files]}
            )
        lines = [json.loads(line) for line in content.splitlines() if line]
        changed = {
            line["value"]["path"]: base64.b64decode(line["value"]["content"]) for line in lines if line["key"] == "file"
        }
        deleted = [line["value"]["path"] for line in lines if line["key"] == "deletedFile"]
        oid = self.server.commit(repository, changed, deleted)
        url = f"{self.server.url}/{repository}/commit/{oid}"
        return self._answer({"success": True, "commitOid": oid, "commitUrl": url})

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        self.server.requests.append(f"{self.command} {path}")
        parts = path.strip("/").split("/")
        listing = parts[:2] == ["api", "models"]
        repository = "/".join(parts[2:4] if listing else parts[:2])
        if repository not in self.server.commits or (
            repository in self.server.private and not self.headers.get("Authorization")
        ):
            return self._answer({"error": "Repository not found"}, 404, {"X-Error-Code": "RepoNotFound"})
        revision = (parts[5] if len(parts) > 4 else "main") if listing else parts[3]
        found = self.server.files(repository, revision)
        if found is None:
            return self._answer({"error": "Invalid rev id"}, 404, {"X-Error-Code": "RevisionNotFound"})
        oid, files = found
        if listing and parts[4:5] == ["tree"]:
            entries = [
                {"type": "file", "path": name, "size": len(content), "oid": hashlib.sha256(content).hexdigest()}
                for name, content in files.items()
            ]
            return self._answer(entries)
        if listing:
            private = repository in self.server.private
            siblings = [{"rfilename": name} for name in files]
            return self._answer({"id": repository, "sha": oid, "siblings": siblings, "tags": [], "private": private})
        name = "/".join(parts[4:])
        if name not in files:
            return self._answer({"error": "no such file"}, 404, {"X-Error-Code": "EntryNotFound"})
        content, etag = files[name], f'"{hashlib.sha256(files[name]).hexdigest()}"'
        self.send_response(200)
        for key, value in (("ETag", etag), ("X-Repo-Commit", oid), ("Content-Length", str(len(content)))):
            self.send_header(key, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content[: len(content) // 2] if name in self.server.cut else content)
        return None

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, content: dict | list, status: int = 200, headers: dict | None = None) -> None:
        text = json.dumps(content).encode()
        self.send_response(status)
        known = {"Content-Type": "application/json", "Content-Length": str(len(text))}
        for key, value in (known | (headers or {})).items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(text)


@contextlib.contextmanager
def serve() -> Iterator[FakeHub]:
    """A hub that answers until the block ends."""
    with FakeHub() as hub:
        thread = threading.Thread(target=hub.serve_forever, daemon=True)
        thread.start()
        try:
            yield hub
        finally:
            hub.shutdown()
            thread.join()
