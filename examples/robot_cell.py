"""A robot cell that asks the service where each box goes, with the standard library alone.

``marl-pack serve --data bins.sqlite`` in one terminal, and in another
``python examples/robot_cell.py http://127.0.0.1:8000 plan.json``.
"""

import json
import sys
import time
import urllib.error
import urllib.request
import uuid

BOXES = [[600, 400, 300], [400, 300, 250], [400, 300, 250], [300, 200, 120], [395, 295, 285]]


class Cell:
    """One pallet, or one container, that boxes are packed into."""

    def __init__(self, address: str, token: str = "", **options: object) -> None:
        self.address = address
        self.headers = {"Content-Type": "application/json"}
        if token:
            self.headers["Authorization"] = f"Bearer {token}"
        self.id = self.post("/bins", options)["id"]

    def post(self, path: str, body: object) -> dict:
        """Send a request until it is answered; the key makes sure that it is done only once."""
        headers = {**self.headers, "Idempotency-Key": uuid.uuid4().hex}
        for pause in (0.1, 0.3, 1, 3, 10):
            try:
                return self.request(path, json.dumps(body).encode(), headers)
            except urllib.error.HTTPError as error:
                if error.code < 500:  # the request is wrong: the same one will not help
                    raise SystemExit(json.load(error)["error"]["message"]) from None
            except OSError:  # no answer: the server may have done it, or not
                pass
            time.sleep(pause)
        raise SystemExit(f"no answer from {self.address}")

    def request(self, path: str, body: bytes | None, headers: dict) -> dict:
        """Send a request once."""
        request = urllib.request.Request(self.address + path, body, headers)
        with urllib.request.urlopen(request, timeout=10) as answer:
            return json.load(answer)

    def plan(self) -> dict:
        """Return what is in the bin."""
        return self.request(f"/bins/{self.id}/plan", None, self.headers)


def main(address: str, path: str) -> None:
    """Pack some boxes, report where they really are, and write the plan."""
    cell = Cell(address, bin_mm=[1200, 800, 1500], margin_mm=20, clearance_mm=10)
    for number, sides in enumerate(BOXES):
        box = {"sides": sides, "id": f"box {number}", "weight": 5.0}
        answer = cell.post(f"/bins/{cell.id}/place", box)
        if not answer["placed"]:
            print(f"{box['id']}: no place: {answer['reason']}")
            continue
        x, y, z = answer["centre"]
        print(f"{box['id']}: placed with its middle at {x:g}, {y:g}, {z:g} mm")
        # Here the robot places the box, and a camera says where it stands.
        pose = {"x": x + 1.5, "y": y - 1.0, "yaw": 0.3, "id": box["id"]}
        actual = cell.post(f"/bins/{cell.id}/actual", pose)
        if actual.get("problem"):
            print(f"{box['id']}: {actual['problem']}")
    cell.post(f"/bins/{cell.id}/close", {})
    with open(path, "w", encoding="utf-8") as file:
        json.dump(cell.plan(), file, indent=1)


if __name__ == "__main__":
    main(*sys.argv[1:])
