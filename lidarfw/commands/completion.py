"""`lidarfw completion`: shell code for <TAB>; names come from the registry."""

from __future__ import annotations

import argparse

_BASH = """_lidarfw() {{
  local line="${{COMP_LINE:0:$COMP_POINT}}"
  COMPREPLY=($(lidarfw completion --line "$line" 2>/dev/null))
  compopt -o nospace 2>/dev/null
}}
{before}COMP_WORDBREAKS=${{COMP_WORDBREAKS//=/}}
complete -F _lidarfw lidarfw
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw completion`."""
    parser.add_argument(
        "shell", nargs="?", choices=("bash", "zsh"), default="bash", help='use: eval "$(lidarfw completion bash)"'
    )
    parser.add_argument("--line", help=argparse.SUPPRESS)  # the line so far; prints the candidates for its last word


def run(args: argparse.Namespace) -> int:
    """Print the shell code, or the candidates for a line."""
    if args.line is None:
        print(_BASH.format(before="autoload -U +X bashcompinit && bashcompinit\n" if args.shell == "zsh" else ""))
        return 0
    print("\n".join(candidates(args.line)))
    return 0


def candidates(line: str) -> list[str]:
    """What may stand at the end of `line`: commands, `group=name`, or keys of the composed config."""
    from lidarfw.cli import COMMANDS

    words = line.split(" ")
    if len(words) <= 2:
        return [name for name in COMMANDS if name.startswith(words[-1])]
    if words[1] not in ("train", "show", "bench", "eval"):
        return []
    return _hydra_candidates(" ".join(words[2:]))


def _hydra_candidates(line: str) -> list[str]:
    # Hydra has no public interface for completion; these two names are tested, and hydra-core is pinned below 1.4
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from hydra._internal.utils import create_config_search_path
    from hydra.core.plugins import Plugins
    from hydra.core.utils import setup_globals
    from hydra.plugins.completion_plugin import DefaultCompletionPlugin

    from lidarfw import config

    setup_globals()
    Plugins.instance()
    config.register()
    loader = ConfigLoaderImpl(config_search_path=create_config_search_path("pkg://lidarfw.conf"))
    found: list[str] = DefaultCompletionPlugin(loader)._query(config_name="train", line=line)
    return found
