"""Completion of commands, options and scenarios at the Tab key."""

from collections.abc import Sequence

from skytether.cli.commands import COMMANDS, KINDS
from skytether.shell.commandline.command import CONFIGURATION, CommandError

HELP = """usage: skytether completion bash|zsh|fish

Print a script for this shell: then the Tab key completes commands, options and
keys, and the names of scenarios.

    eval "$(skytether completion bash)"              # in ~/.bashrc
    eval "$(skytether completion zsh)"               # in ~/.zshrc
    skytether completion fish | source               # in config.fish"""
OPTIONS = (
    '(skytether "$asked" --help; skytether "$asked" --help-keys) 2>/dev/null'
    " | grep -oE -e '--[a-z][a-z0-9.-]*[a-z0-9]' | sort -u"
)
"""Shell command that extracts the options of a command from its help."""
SCENARIOS = "skytether list scenarios 2>/dev/null | cut -d ' ' -f 1"
BASH = f"""\
_skytether_asked=
_skytether_options=
_skytether() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} asked=${{COMP_WORDS[1]}} words=
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="COMMANDS"
    elif [ "${{word#-}}" != "$word" ]; then
        if [ "$asked" != "$_skytether_asked" ]; then
            _skytether_options=$({OPTIONS})
            _skytether_asked=$asked
        fi
        words=$_skytether_options
    elif [ "$COMP_CWORD $asked" = "2 list" ]; then
        words="{" ".join(KINDS)}"
    elif [ "$COMP_CWORD" -eq 2 ]; then
        words=$({SCENARIOS})
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _skytether skytether
"""
FISH_OPTIONS = OPTIONS.replace("(", "begin; ", 1).replace(")", "; end", 1)
FISH = f"""\
complete -c skytether -n __fish_use_subcommand -f -a "COMMANDS"
function __skytether_options
    set asked (commandline -opc)[2]
    {FISH_OPTIONS}
end
complete -c skytether -n 'string match -q -- "-*" (commandline -ct)' -f \\
    -a "(__skytether_options)"
function __skytether_names
    if test (commandline -opc)[2] = list
        string split " " "{" ".join(KINDS)}"
    else
        {SCENARIOS}
    end
end
complete -c skytether -n 'test (count (commandline -opc)) -eq 2' -a "(__skytether_names)"
"""
SCRIPTS = {
    "bash": BASH,
    "zsh": "autoload -Uz compinit bashcompinit && compinit -u && bashcompinit\n" + BASH,
    "fish": FISH,
}


def complete(argv: Sequence[str]) -> None:
    match argv:
        case ["-h" | "--help", *_]:
            print(HELP)
        case [shell] if shell in SCRIPTS:
            print(SCRIPTS[shell].replace("COMMANDS", " ".join(COMMANDS)), end="")
        case _:
            got = " ".join(argv) or "nothing"
            raise CommandError(f"got {got}, expected {', '.join(SCRIPTS)}", CONFIGURATION)
