"""One trial in the laboratory with a report to look at: ``demo.sh --live``."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path

from magic_bringup import report
from magic_bringup.record import Record, empty_summary, take, write_summary
from magic_core import environment, viewerless
from magic_core.errors import Code, MagicError
from magic_lab.scenarios import SCENARIOS, case_of, scenario_of
from magic_lab.trials import Session


def main(argv: list[str] | None = None) -> int:
    """Status 0 where the goal was truly reached, 1 where not, 2 for wrong arguments, 130 when interrupted."""
    parser = argparse.ArgumentParser(prog="demo.sh --live", description="One trial in the simulated laboratory, judged on the truth.")
    parser.add_argument("--live", action="store_true", help="no bag, but the laboratory")
    parser.add_argument("--scenario", default="hooking", choices=tuple(SCENARIOS), help="default hooking")
    parser.add_argument("--object", default="", help="which of the scenario's objects (default: the seed chooses)")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn (default 0)")
    parser.add_argument("--out", type=Path, help="folder for summary.json, the video and report.html (default out/live_<scenario>)")
    parser.add_argument("--root", type=Path, default=Path.cwd(), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    out = (options.out or options.root / "out" / f"live_{options.scenario}").resolve()
    scenario = scenario_of(options.scenario)
    begin = time.monotonic()

    def say(line: str) -> None:
        print(f"[{time.monotonic() - begin:6.1f} s] {line}", flush=True)

    try:
        case = case_of(scenario, options.object, options.seed)
        environment.prepare()
        viewerless.prepare()
        out.mkdir(parents=True, exist_ok=True)
        say(f"starting the graph and the laboratory: {scenario.name}, {case.name}, seed {options.seed}")
        with Session(out / "logs", say, pictures=True) as session:
            session.ready()
            say("looking at the table")
            trial = session.trial(scenario, case.name, options.seed, out)
    except MagicError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 2 if error.code == Code.BAD_REQUEST else 1
    except KeyboardInterrupt:
        return 130
    record = Record(empty_summary(scenario.strategy, "arm", "embedded", shlex.join(["demo.sh", *(argv or sys.argv[1:])])))
    record.scene, record.images, record.result = session.watcher.scene, session.seen.first, session.result
    if session.result is not None:
        take(record.summary, session.result)
    else:
        record.summary.update(code=trial["code"], message=trial["reason"])
    record.summary["trial"] = trial
    truly = trial.get("judgement", "nothing happened that could be judged")
    record.summary["notes"].append(f"judged on the truth of the simulated laboratory: {truly}")
    if "video" in trial:
        record.video = (out / trial["video"]).read_bytes()
    write_summary(record, out)
    report.save(record, out)
    report.write(record, out / "report.html", out / "logs")
    say(f"{'succeeded' if trial['success'] else 'failed at ' + trial['stage']}: {truly}")
    if not trial["success"]:
        say(f"{Code(trial['code']).name}: {trial['reason']}")
    print(f"summary: {out / 'summary.json'}\nreport:  {out / 'report.html'}", flush=True)
    return 0 if trial["success"] else 1


if __name__ == "__main__":
    sys.exit(main())
