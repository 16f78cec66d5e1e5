_nsde_complete() {
    local line="${COMP_LINE:0:COMP_POINT}" words current offset
    read -ra words <<< "$line"
    [[ "$line" == *" " ]] && words+=("")
    current="${words[${#words[@]}-1]}"
    mapfile -t COMPREPLY < <("${words[0]}" completion query "${words[@]:1}" 2>/dev/null)
    # Bash replaces only what follows the last of its word breaks (= and :), so cut what stands before it.
    if [[ "$COMP_WORDBREAKS" == *"="* && "$current" == *"="* ]]; then
        offset="${current%"${current##*=}"}"
        COMPREPLY=("${COMPREPLY[@]#"$offset"}")
    fi
    [[ ${#COMPREPLY[@]} -eq 1 && "${COMPREPLY[0]}" != *[=./] ]] && COMPREPLY[0]+=" "
}
complete -o nospace -F _nsde_complete nsde
