_cvtgs() {
    local current="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}"
    local command="${COMP_WORDS[1]}" words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W "@commands@" -- "$current"))
        return
    fi
    if [ "$current" = "=" ]; then  # bash splits --option=value into three words
        current=""
    elif [ "$before" = "=" ]; then
        before="${COMP_WORDS[COMP_CWORD-2]}"
    fi
    case "$command $before" in
@values@
    esac
    if [ -z "$words" ] && [[ "$current" == -* ]]; then
        case "$command" in
@options@
        esac
    fi
    if [ -n "$words" ]; then
        COMPREPLY=($(compgen -W "$words" -- "$current"))
    fi
    if [ -z "$words" ] || [ "$before" = --ckpt ]; then
        local IFS=$'\n'  # names may hold spaces
        COMPREPLY+=($(compgen -f -- "$current"))
    fi
}
complete -o filenames -F _cvtgs cvtgs
