function __nsde_complete
    set -l words (commandline -opc) (commandline -ct)
    $words[1] completion query $words[2..-1] 2>/dev/null
end
complete -c nsde -f -a '(__nsde_complete)'
