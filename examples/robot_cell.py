"""A robot cell that asks the service where each box goes, with the standard library alone.

``marl-pack serve --data bins.sqlite`` in one terminal, and in another
``python examples/robot_cell.py http://127.0.0.1:8000 pallet-7 plan.json``. Run it again after it
was stopped, also in the middle: it goes on with the same pallet, and places no box twice.
"""

import argparse
import json
import time
import urllib.error
import urllib.request

BOXES = [[600, 400, 300], [400, 300, 250], [400, 300, 250], [300, 200, 120], [395, 295, 285]]


class RefusedError(Exception):
    """The service refused a request."""


class Cell:
    """One pallet, or one container, that boxes are packed into.

    The id of the pallet and the keys of the requests come from the cell, not from chance. So a
    client that starts again repeats its requests, and gets the answers that it got before.
    """

    def __init__(self, address: str, id: str, token: str = "", **options: object) -> None:
        self.address, self.id = address.rstrip("/"), id
        self.headers = {"Content-Type": "application/json"}
        if token:
            self.headers["Authorization"] = f"Bearer {token}"
        self.send("/bins", f"open {id}", id=id, **options)

    def send(self, path: str, key: str, **body: object) -> dict:
        """Send a request until it is answered; the key makes sure that it is done only once."""
        headers = {**self.headers, "Idempotency-Key": key}
        for pause in (0.1, 0.3, 1, 3, 10, 30):
            try:
                return self.ask(path, json.dumps(body).encode(), headers)
            except urllib.error.HTTPError as error:
                if error.code < 500:  # the request is wrong: the same one will not help
                    raise RefusedError(json.load(error)["error"]["message"]) from None
            except OSError:  # no answer: the server may have done it, or not
                pass
            time.sleep(pause)
        raise SystemExit(f"no answer from {self.address}")

    def ask(self, path: str, body: bytes | None, headers: dict) -> dict:
        """Send a request once."""
        request = urllib.request.Request(self.address + path, body, headers)
        with urllib.request.urlopen(request, timeout=10) as answer:
            return json.load(answer)

    def place(self, name: str, sides: list, **box: object) -> dict:
        """Return where a box goes, or why it has no place."""
        return self.send(f"/bins/{self.id}/place", f"place {name}", id=name, sides=sides, **box)

    def report(self, name: str, x: float, y: float, yaw: float) -> dict:
        """Report where the robot really put the box that was placed last."""
        return self.send(f"/bins/{self.id}/actual", f"actual {name}", id=name, x=x, y=y, yaw=yaw)

    def close(self) -> dict:
        """Close the pallet, and return its plan."""
        self.send(f"/bins/{self.id}/close", "close")
        return self.ask(f"/bins/{self.id}/plan", None, self.headers)


def main() -> None:
    """Pack some boxes, report where they really are, and write the plan."""
    options = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    options.add_argument("address", help="such as http://127.0.0.1:8000")
    options.add_argument("pallet", help="id of the pallet, such as pallet-7")
    options.add_argument("plan", help="file for the plan (.json)")
    options.add_argument("--token", default="", help="the token of the server, if it has one")
    chosen = options.parse_args()
    if not chosen.address.startswith(("http://", "https://")):
        options.error(f"address {chosen.address}: needs http:// or https://")
    try:
        cell = Cell(
            chosen.address, chosen.pallet, chosen.token,
            bin_mm=[1200, 800, 1500], margin_mm=20, clearance_mm=10,
        )  # fmt: skip
        for number, sides in enumerate(BOXES):
            name = f"box {number}"
            answer = cell.place(name, sides, weight=5.0)
            if not answer["placed"]:  # another pallet, or by hand
                print(f"{name}: no place: {answer['reason']}")
                continue
            x, y, z = answer["centre"]
            print(f"{name}: middle at {x:g}, {y:g}, {z:g} mm")
            # Here the robot places the box, and a camera says where it stands.
            try:
                actual = cell.report(name, x + 1.5, y - 1.0, 0.3)
            except RefusedError as reason:  # no box can be there: measure again, or move the box
                print(f"{name}: {reason}")
                continue
            if actual.get("problem"):  # it is there, and does not stand safely: move it
                print(f"{name}: {actual['problem']}")
        plan = cell.close()
    except RefusedError as reason:
        raise SystemExit(str(reason)) from None
    with open(chosen.plan, "w", encoding="utf-8") as file:
        json.dump(plan, file, indent=1)


if __name__ == "__main__":
    main()
